"""The benchmark's matrix on a scene of a few frames: fitted, scored, resumed, drawn, and told on the page."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_bench
from small_job import SMALL
from test_prior_job import Heard, written
from tiny_bench import NUM_FRAMES, NUM_SEEN, VIEWS, draw_scene

from backend.contract.errors import BackendError
from backend.contract.job import Config, Job, override
from backend.contract.result import read_result
from backend.events_out import StopRequest
from backend.geometry.camera import view_at
from backend.io.job_folder import JobFolder
from backend.pipeline import run_job, stages_of
from backend.score.finished_job import score_job
from backend.score.truth_set import read_truth_set
from benchmarks import reconstruction, reconstruction_figures, tilted_scene
from tools import results

SETTINGS = {name: value for name, value in SMALL.items() if not name.startswith("forecast.")} | {
    "volume.use_prior": "false",
    "published.num_physical": "80",
    "published.num_particles": "150",
    "published.physical_iterations": "1",
    "published.visual_iterations": "1",
}
METHODS = ("default", "as_published")


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench")
    draw_scene(folder / "wind_wisp", wind=0.4)
    return folder


@pytest.fixture(scope="module")
def made(bench: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("matrix")
    assert run(folder, bench, "--json", str(folder / "short.json")) == 0
    return folder


def run(folder: Path, bench: Path, *more: str) -> int:
    settings = [part for key, value in SETTINGS.items() for part in ("--set", f"{key}={value}")]
    basis = ["--out", str(folder), "--from", str(bench), "--presets", "draft", "--methods", ",".join(METHODS)]
    return reconstruction.main([*basis, *settings, *more])


def test_every_cell_is_there_with_what_it_cost_and_scored(made: Path) -> None:
    found = json.loads((made / "results.json").read_text(), parse_constant=pytest.fail)
    assert [cell["method"] for cell in found["cells"]] == list(METHODS)
    assert found["settings"]["draft default"]["visual"]["num_particles"] == 400
    assert found["settings"]["draft default"]["forecast"]["num_frames"] == NUM_FRAMES - NUM_SEEN
    for cell in found["cells"]:
        assert (cell["scene"], cell["preset"], cell["untouched"], cell["weights"]) == ("wind_wisp", "draft", True, None)
        cost = cell["cost"]
        assert set(cost["stages"]) == {"start", *stages_of(override(Config(), {"volume.use_prior": False}))}
        assert 0.5 * cost["seconds"] < sum(cost["stages"].values()) < cost["seconds"] + 0.1
        assert cost["cpu_seconds"] > 0.5 and 0.1 < cost["peak_gib"] < 3.0 and not cost["is_resumed"]
        scores = cell["scores"]
        assert scores["input"]["ours"]["smoke_db"] > scores["input"]["black"]["smoke_db"] + 3.0
        assert list(scores["nvs"]["copy"]["by_frame_db"]) == ["0", "2", "4"]
        assert list(scores["future_nvs"]["ours"]["by_frame_db"]) == ["6"]
        assert scores["volume"]["correlation"] > 0.3
        assert {"as_published", "corrected", "coverage"} == set(scores["divergence"])
        assert "prior_volume" not in scores


def test_the_short_file_leaves_out_single_frames_only(made: Path) -> None:
    whole, short = (json.loads((made / name).read_text()) for name in ("results.json", "short.json"))
    assert "by_frame_" not in (made / "short.json").read_text()
    assert [cell["scores"]["side"]["ours"]["full_db"] for cell in short["cells"]] == [
        cell["scores"]["side"]["ours"]["full_db"] for cell in whole["cells"]
    ]
    assert short["machine"]["cores"] >= 1 and short["versions"]["numpy"]


def test_what_is_there_is_not_made_again(made: Path, bench: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in (made / "draft").rglob("*") if path.is_file()}
    text = (made / "results.json").read_text()
    assert run(made, bench) == 0
    assert {path: path.stat().st_mtime_ns for path in (made / "draft").rglob("*") if path.is_file()} == before
    assert (made / "results.json").read_text() == text


def test_other_settings_are_refused_in_the_same_folder(made: Path, bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (made / "results.json").read_text()
    assert run(made, bench, "--set", "visual.iterations=1", "--methods", "default") == 1
    assert "made with other settings" in capsys.readouterr().err
    assert (made / "results.json").read_text() == text


def test_an_interrupted_job_goes_on_and_says_so(made: Path, bench: Path) -> None:
    """Last but for those that only read: it makes one cell anew."""
    record = made / "draft" / "default" / "wind_wisp.json"
    before = json.loads(record.read_text())
    record.unlink()
    (record.with_suffix("") / "stages" / "visual.h5").unlink()
    assert run(made, bench) == 0
    after = json.loads(record.read_text())
    assert after["cost"]["is_resumed"] and not before["cost"]["is_resumed"]
    assert after["scores"] == before["scores"]


def test_the_pictures_are_drawn(made: Path, bench: Path, tmp_path: Path) -> None:
    assert reconstruction_figures.main([str(made), "--out", str(tmp_path), "--from", str(bench)]) == 0
    sizes = {path.name: path.stat().st_size for path in tmp_path.iterdir()}
    assert set(sizes) == {
        f"reconstruction_{name}" for name in ("middle.jpg", "last.jpg", "methods.jpg", "angle.png", "horizon.png")
    }
    assert max(sizes.values()) < 400_000
    sheet = cv2.imread(str(tmp_path / "reconstruction_last.jpg"))
    assert sheet.shape == (20 + 64, 8 * (48 + 4), 3)
    truth, ours = (sheet[30:70, left + 2 : left + 46].astype(float) for left in (0, 52))
    assert truth.std() > 20 and ours.std() > 20 and np.corrcoef(truth.ravel(), ours.ravel())[0, 1] > 0.7


def test_the_page_tells_what_the_file_holds(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in results.FIGURES.glob("*.json"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "reconstruction.json").unlink(missing_ok=True)
    monkeypatch.setattr(results, "FIGURES", tmp_path)
    assert "## Reconstruction" not in results.page()
    (tmp_path / "reconstruction.json").write_bytes((made / "short.json").read_bytes())
    page = results.page()
    assert "## Reconstruction" in page and "wind_wisp*" in page and "reached" not in page, "nothing was made at `final`"
    for cell in json.loads((made / "short.json").read_text())["cells"]:
        assert f"{cell['scores']['back']['ours']['full_db']:.2f}" in page


def test_a_job_that_asked_the_prior_is_scored_beside_it(bench: Path, tmp_path: Path) -> None:
    scene = bench / "wind_wisp"
    clip, cameras = (str(scene / "input" / name) for name in ("smoke.mkv", "cameras.json"))
    job = Job(video=clip, cameras=cameras, overrides={**SMALL, "volume.use_prior": True})
    JobFolder(tmp_path).write_job(job)
    run_job(tmp_path, Heard(), StopRequest(), weights=written(tmp_path / "weights.npz", seed=1))
    scores = score_job(JobFolder(tmp_path), read_truth_set(scene))
    assert -1.0 < scores["prior_volume"]["correlation"] < 1.0 and scores["prior_volume"]["mass_ratio"] > 0.0
    assert list(scores["side"]["ours"]["by_frame_db"]) == [str(frame) for frame in VIEWS["side"]]


def test_a_turned_world_turns_the_answer(bench: Path, tmp_path: Path) -> None:
    """Turned by 0 and by 30 degrees: the same pictures, and a buoyancy that is measured against another up."""
    rows = []
    for degrees in (0.0, 30.0):
        settings = [part for key, value in SETTINGS.items() for part in ("--set", f"{key}={value}")]
        basis = ["--out", str(tmp_path), "--from", str(bench), "--preset", "draft", "--degrees", f"{degrees}"]
        assert tilted_scene.main([*basis, *settings, "--json", str(tmp_path / "rows.json")]) == 0
        rows += json.loads((tmp_path / "rows.json").read_text())["rows"]
        learned = np.array(read_result(tmp_path / f"wind_wisp_draft_{degrees:g}").buoyancy)
        up = np.array([0.0, -np.sin(np.radians(degrees)), np.cos(np.radians(degrees))])
        expected = np.degrees(np.arccos(learned @ up / np.linalg.norm(learned)))
        assert rows[-1]["degrees_from_up"] == pytest.approx(expected, abs=0.01)
    text = "\n".join(results.tilted_scene({"rows": rows}))
    assert f"| wind_wisp* | draft | 30 | {rows[1]['strength']:.2f} | {rows[1]['degrees_from_up']:.1f} |" in text


def test_tilted_cameras_see_a_tilted_world_alike() -> None:
    cameras = tiny_bench.cameras("input")
    turned = tilted_scene.tilted(cameras, 40.0)
    points = np.random.default_rng(0).uniform(-1.0, 2.0, (20, 3))
    for frame in (0, NUM_FRAMES - 1):
        before = view_at(cameras, frame).project(points)
        after = view_at(turned, frame).project(points @ tilted_scene.turn(40.0)[:3, :3].T)
        assert np.allclose(before[0], after[0]) and np.allclose(before[1], after[1])
    assert tilted_scene.degrees_between(np.zeros(3), np.ones(3)) is None
    assert tilted_scene.degrees_between(np.array([0.0, 0.0, 3.0]), tilted_scene.turn(25.0)[:3, 2]) == pytest.approx(25.0)


def test_a_job_of_fewer_frames_is_refused(made: Path, bench: Path) -> None:
    truth = read_truth_set(bench / "wind_wisp")
    with pytest.raises(BackendError, match="shows 5"):
        score_job(JobFolder(made / "draft" / "default" / "wind_wisp"), replace(truth, num_seen=5))
