"""`bench` on a scene of a few frames: cells are whole or absent, what is there is not made again, costs add up."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from tiny_bench import NUM_SEEN, draw_scene

from backend.contract.errors import BackendError
from benchmarks import trade, trade_figures
from benchmarks.trade_plan import Trial, with_donors
from tools import trade_page

STAGES = ["start", "inspect", "frames", "smoke", "cameras", "volume", "physical", "visual", "forecast", "export"]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    draw_scene(folder / "helix", wind=0.4)
    return folder


@pytest.fixture(scope="module")
def made(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trade")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trade, "warm_up", lambda cells: None)  # nobody compares these seconds
        assert run(folder, source) == 0
    return folder


def run(folder: Path, source: Path, *more: str) -> int:
    basis = ["--out", str(folder), "--from", str(source), "--scenes", "helix", "--frames", f"0:{NUM_SEEN}"]
    return trade.main([*basis, "--threads", "1", "--only", "draft seed=1", *more])


def cells_of(folder: Path) -> dict[int, dict[str, Any]]:
    """By seed."""
    found = json.loads((folder / "trade.json").read_text(), parse_constant=pytest.fail)["cells"]
    return {cell["seed"]: cell for cell in found}


def test_a_trial_and_the_one_that_it_takes_from(made: Path) -> None:
    cells = cells_of(made)
    assert sorted(cells) == [0, 1]
    for cell in cells.values():
        assert (cell["scene"], cell["preset"], cell["frames"], cell["threads"]) == ("helix", "draft", [0, NUM_SEEN], 1)
        assert list(cell["stages"]) == STAGES
        for key in ("seconds", "cpu_seconds"):
            assert cell[key] == pytest.approx(
                sum(stage[key] for name, stage in cell["stages"].items() if name != "inspect"), abs=0.01
            )
        assert 0.1 < cell["peak_gib"] < 3.0 and cell["cpu_seconds"] > 0.5
        scores = cell["scores"]
        assert {"input_smoke_db", "nvs_db", "side_db", "nvs_last_db", "future_nvs_db"} <= scores.keys()
        assert {"density_correlation", "velocity_depth", "vdb_correlation", "vdb_mib_a_frame", "mass_ratio"} <= scores.keys()
        assert scores["input_smoke_db"] > 20.0 and scores["density_correlation"] > 0.2
        assert scores["vdb_correlation"] == pytest.approx(scores["density_correlation"], abs=0.1)


def test_trivial_answers_stand_beside_the_results(made: Path) -> None:
    found = json.loads((made / "trade.json").read_text())["trivial"]["helix"]
    assert set(found) == {f"{view}_{answer}_db" for view in ("nvs", "side") for answer in ("copy", "mirror")}
    assert found["nvs_copy_db"] > found["nvs_mirror_db"] + 1.0, "the first picture of the input is that of the novel view"


def test_stages_of_the_same_settings_are_run_once_and_counted_twice(made: Path) -> None:
    first, second = (cells_of(made)[seed]["stages"] for seed in (0, 1))
    taken = [name for name, stage in second.items() if stage["is_taken_over"]]
    assert taken == ["inspect", "frames", "smoke", "cameras", "volume"], "random numbers begin with the physical particles"
    assert not any(stage["is_taken_over"] for stage in first.values())
    for name in taken:
        assert {**second[name], "is_taken_over": False} == first[name]
    assert cells_of(made)[1]["peak_gib"] >= first["volume"]["peak_gib"]


def test_what_is_there_is_not_made_again(made: Path, source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trade, "run", pytest.fail)
    text = (made / "trade.json").read_text()
    assert run(made, source) == 0
    assert (made / "trade.json").read_text() == text


def test_only_the_donors_jobs_are_kept(made: Path) -> None:
    assert [path.name for path in (made / "jobs" / "helix").iterdir()] == [path.stem for path in donors_records(made)]
    assert not list(made.rglob("*.part")) and not list(made.glob("warm_up*"))


def donors_records(made: Path) -> list[Path]:
    return [path for path in (made / "cells" / "helix").iterdir() if "seed" not in path.name]


def test_a_job_that_was_interrupted_is_begun_again(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cell without a record: what lies in its job folder is no measurement. One whose donor's job is gone has it made."""
    asked: list[str] = []

    def note(cell: trade.Cell, record: Path) -> None:
        asked.append(cell.trial.name)
        cell.job.mkdir(parents=True, exist_ok=True)

    monkeypatch.setattr(trade, "run", note)
    root = made / "elsewhere"
    trial = Trial(preset="draft", seed=1)
    cell = trade.Cell(root=root, scene=Path("helix"), trial=trial)
    cell.job.mkdir(parents=True)
    (cell.job / "half").touch()
    trade.make(cell)
    assert asked == ["draft", "draft seed=1"] and not cell.job.exists()
    trade.make(cell)
    assert asked[2:] == ["draft seed=1"], "the donor's job is there"


def test_an_export_is_never_taken_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the donor's export left would do half the work of another one."""
    found: dict[str, set[str]] = {}

    def note(cell: trade.Cell, record: Path) -> None:
        found[cell.trial.name] = {path.name for path in cell.job.iterdir()} if cell.job.exists() else set()
        (cell.job / "vdb").mkdir(parents=True, exist_ok=True)
        for name in ("particles.h5", "result.json", "timing.json"):
            (cell.job / name).touch()

    monkeypatch.setattr(trade, "run", note)
    trial = Trial(preset="draft", changes=(("export.max_voxels", "32"),))
    trade.make(trade.Cell(root=tmp_path, scene=Path("helix"), trial=trial))
    assert found == {"draft": set(), "draft export.max_voxels=32": {"timing.json"}}


def test_kernels_are_compiled_before_anything_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[trade.Cell] = []

    def note(cell: trade.Cell, record: Path) -> None:
        asked.append(cell)
        for folder in (record.parent, cell.job):
            folder.mkdir(parents=True, exist_ok=True)

    monkeypatch.setattr(trade, "run", note)
    cell = trade.Cell(root=tmp_path, scene=Path("helix"), trial=Trial(preset="final", seed=1))
    assert trade.measure([cell]) == 0
    assert [found.trial.changes for found in asked[:2]] == [(), (("volume.use_prior", "false"),)], "with the prior and without"
    assert all(found.trial.frames[1] - found.trial.frames[0] == 4 for found in asked[:2])
    assert [found.trial.name for found in asked[2:]] == ["final", "final seed=1"]
    assert not list(tmp_path.glob("warm_up*"))


def test_what_other_sources_made_is_refused(made: Path, source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = donors_records(made)[0]
    text = path.read_text()
    path.write_text(text.replace(json.loads(text)["code"], "0" * 12))
    try:
        assert run(made, source) == 2
    finally:
        path.write_text(text)
    assert "other sources" in capsys.readouterr().err


def test_scenes_that_are_kept_for_figures_are_refused(source: Path, tmp_path: Path) -> None:
    with pytest.raises(BackendError, match="wind_wisp is kept"):
        trade.scene_folder(trade.SETS, "wind_wisp")
    with pytest.raises(BackendError, match="no benchmark scene"):
        trade.scene_folder(source, "none")
    assert trade.main(["--out", str(tmp_path), "--scenes", "obstacle_plume"]) == 2


def test_a_cell_that_fails_leaves_no_record(source: Path, tmp_path: Path) -> None:
    trial = Trial(preset="draft", changes=(("visual.iterations", "many"),), frames=(0, NUM_SEEN), scored_from=0)
    cell = trade.Cell(root=tmp_path, scene=source / "helix", trial=trial)
    with pytest.raises(RuntimeError, match=r"visual\.iterations"):
        trade.run(cell, cell.record)
    assert not cell.record.exists()


def test_the_runner_is_small() -> None:
    """Else the system would count what it holds as the jobs' peak memory."""
    import subprocess

    program = "import benchmarks.trade, sys; assert 'numpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True, cwd=trade.CHECKOUT)


def test_plots_and_page_of_what_was_measured(made: Path, tmp_path: Path) -> None:
    results = json.loads((made / "trade.json").read_text())
    both = results["cells"]
    for preset, factor in (("preview", 2.0), ("final", 6.0)):
        for cell in cells_of(made).values():
            name = cell["name"].replace("draft", preset)
            both = [*both, {**cell, "preset": preset, "name": name, "cpu_seconds": factor * cell["cpu_seconds"]}]
    results["cells"] = both
    path = tmp_path / "trade.json"
    path.write_text(json.dumps(results))
    assert trade_figures.main(["--json", str(path), "--out", str(tmp_path)]) == 0
    assert {found.name for found in tmp_path.glob("*.png")} == {"trade_front.png", "trade_sweeps.png"}


def test_a_plan_begins_with_donors() -> None:
    assert [trial.name for trial in with_donors([Trial(preset="final", seed=1)])] == ["final", "final seed=1"]
    assert trade_page.setting("final seed=1") == "`final seed=1`"
