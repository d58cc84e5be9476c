"""The command `evaluate` from end to end on a scene of a few frames: table, JSON, page, Cycles by a stand-in, refusals."""

from __future__ import annotations

import base64
import json
import os
import re
import signal
import subprocess
import sys
import time
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
import scored_job
from small_job import environment
from tiny_bench import NUM_SEEN, draw_scene

from backend.__main__ import main
from backend.contract.errors import BackendError, Cancelled
from backend.contract.result import RESULT_FILE
from backend.io.particles import read_particles
from backend.reporting import SilentReport
from backend.score.page import chart, markup, pictures
from backend.score.page.views import views_of
from backend.score.particles import ParticlePrediction
from backend.score.relight import RelightConfig, find_blender, relight_scores
from backend.score.truth_set import read_truth_set

WIND = 0.4
OFF = 0.7  # m/s of the job's wind: right in the input view's time only roughly
STAND_IN = f"""#!{sys.executable} -S
import shutil, sys, time
from pathlib import Path
given = dict(zip(sys.argv[1:], sys.argv[2:]))
print("blender 9.9.9", flush=True)
print("noise", file=sys.stderr)
for text in given["--layer-frames"].split(","):
    path = Path(given["--layers"]) / f"{{int(text):04d}}.npy"
    MODE
    shutil.copy(f"PERFECT/{{int(text)}}.npy", path)
    print("layer", text, flush=True)
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return draw_scene(tmp_path_factory.mktemp("bench") / "wind_wisp", wind=WIND)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scored_job.make_job(tmp_path_factory.mktemp("job") / "job", wind=OFF).path


@pytest.fixture(scope="module")
def perfect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a perfect Cycles would draw of a perfect volume, by Blender's frame."""
    folder = tmp_path_factory.mktemp("perfect")
    for frame in range(NUM_SEEN):
        np.save(folder / f"{frame + 1}.npy", scored_job.layer(frame, WIND))
    return folder


def stand_in(folder: Path, perfect: Path, mode: str = "pass") -> Path:
    """A Blender that has the pictures at hand."""
    path = folder / "blender"
    path.write_text(STAND_IN.replace("MODE", mode).replace("PERFECT", str(perfect)))
    path.chmod(0o755)
    return path


class Elements(HTMLParser):
    """Tags with their attributes, and the text of the page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.words = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words += data

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


def test_the_whole_command(scene: Path, job: Path, perfect: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in job.rglob("*")}
    page, figures = tmp_path / "report.html", tmp_path / "scores.json"
    options = ["--html", str(page), "--out", str(figures), "--relight", str(tmp_path / "drawn"), "--relight-frames", "2"]
    options += ["--blender", str(stand_in(tmp_path, perfect))]
    assert main(["evaluate", "--job", str(job), "--truth", str(scene), *options]) == 0
    scores = json.loads(figures.read_text(), parse_constant=pytest.fail)
    table = capsys.readouterr().out
    assert f"{scores['side']['ours']['full_db']:.2f}" in table and "tOF" in table and "lpips: no weights" in table
    assert set(scores["not_measured"]) == {"exported", "lpips"}, "the job was made without volumes"
    assert scores["job"] == {"program": "wildsmoke 0", "preset": "draft", "method": "default"}, "no times: equal jobs score equal"
    assert scores["relight"]["ours"]["full_db"] > scores["relight_particles"]["full_db"] + 5.0
    assert scores["relight_by"] == {"program": "Blender 9.9.9", "samples": 16, "width": 48, "height": 64}
    assert {path: path.stat().st_mtime_ns for path in job.rglob("*")} == before, "the job is left alone"
    check_page(page.read_text(encoding="utf-8"), scores)


def check_page(text: str, scores: dict) -> None:
    """It stands alone, is well formed, tells those who do not see what is shown, and holds the figures."""
    found = Elements(text)
    assert found.open == [] and found.of("html")[0]["lang"] == "en"
    assert not re.search(r"https?://|url\(|@import|<script|<link", text)
    images = found.of("img")
    assert images and all(image["alt"] and (image["src"] or "").startswith("data:image/jpeg;base64,") for image in images)
    data = base64.b64decode((images[0]["src"] or "").partition(",")[2])
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape[0] > 50
    names = {attributes.get("id") for _, attributes in found.tags}
    assert {(link["href"] or "").removeprefix("#") for link in found.of("a")} <= names
    charts = [svg for svg in found.of("svg") if svg.get("role") == "img"]
    assert len(charts) >= 3 and all(svg["aria-label"] for svg in charts)
    for view, answers in views_of(scores).items():
        for answer, row in answers.items():
            assert f"{row['full_db']:.2f}" in found.words, (view, answer)
    for words in ("As Cycles shows it", "Not measured", "density correlation", "Blender 9.9.9", "21.8"):
        assert words in found.words, words


def test_views_known_by_name_come_first() -> None:
    ours = {"ours": {}}
    order = list(views_of({"camera b": ours, "future_nvs": ours, "back": ours, "relight": ours, "input": ours, "volume": {}}))
    assert order == ["input", "back", "camera b", "future_nvs"]


def relit(job: Path, scene: Path, config: RelightConfig, report=None) -> dict:
    with read_particles(job / "particles.h5") as particles:
        truth = read_truth_set(scene)
        return relight_scores(job, ParticlePrediction(particles), truth, config, report=report or SilentReport())


def test_what_cycles_drew_is_kept(scene: Path, job: Path, perfect: Path, tmp_path: Path) -> None:
    config = RelightConfig(folder=tmp_path / "drawn", blender=stand_in(tmp_path, perfect), num_frames=2)
    first = relit(job, scene, config)
    assert first["relight"]["ours"]["full_db"] == 50.0 and len(first["relight"]["ours"]["by_frame_db"]) == 2
    files = sorted((tmp_path / "drawn").rglob("*.npy"))
    stamps = [path.stat().st_mtime_ns for path in files]
    stand_in(tmp_path, perfect, "raise SystemExit(3)")
    assert relit(job, scene, config) == first and [path.stat().st_mtime_ns for path in files] == stamps
    files[0].write_bytes(b"half")
    with pytest.raises(BackendError, match="cannot be read"):
        relit(job, scene, config)


def test_pictures_of_another_result_are_not_taken(scene: Path, job: Path, perfect: Path, tmp_path: Path) -> None:
    config = RelightConfig(folder=tmp_path / "drawn", blender=stand_in(tmp_path, perfect), num_frames=1)
    relit(job, scene, config)
    other = scored_job.make_job(tmp_path / "other", wind=0.1).path
    stand_in(tmp_path, perfect, "sys.exit('no GPU')")
    with pytest.raises(BackendError, match="Blender ended with code 1: no GPU"):
        relit(other, scene, config)


def test_a_cancel_ends_blender(scene: Path, job: Path, perfect: Path, tmp_path: Path) -> None:
    """The first picture is drawn, the second never would be."""

    class Stops(SilentReport):
        def progress(self, step: int, total: int, **metrics: float) -> None:
            if step == 1:
                raise Cancelled

    mode = f"if list(path.parent.glob('*.npy')): Path({str(tmp_path / 'pid')!r}).write_text('x'); time.sleep(60)"
    config = RelightConfig(folder=tmp_path / "drawn", blender=stand_in(tmp_path, perfect, mode), num_frames=3)
    began = time.monotonic()
    with pytest.raises(Cancelled):
        relit(job, scene, config, Stops())
    assert time.monotonic() - began < 30.0
    assert len(list((tmp_path / "drawn").rglob("*.npy"))) == 1


def test_finding_blender(perfect: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = stand_in(tmp_path, perfect)
    assert find_blender(here) == here
    with pytest.raises(BackendError, match="There is no"):
        find_blender(tmp_path / "nothing")
    monkeypatch.setattr("backend.score.relight._CHECKOUT", tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_blender(None) == here
    monkeypatch.setenv("PATH", "")
    with pytest.raises(BackendError, match="Blender was not found"):
        find_blender(None)


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_an_interrupt_ends_it_cleanly(scene: Path, job: Path, perfect: Path, tmp_path: Path) -> None:
    """Control-C while Cycles draws: exit code 0, and no file of a report that is not whole."""
    blender = stand_in(tmp_path, perfect, "time.sleep(60)")
    command = [sys.executable, "-m", "backend", "evaluate", "--job", job, "--truth", scene, "--out", tmp_path / "scores.json"]
    command += ["--relight", tmp_path / "drawn", "--blender", blender, "--html", tmp_path / "report.html"]
    command, options = list(map(str, command)), {"stderr": subprocess.PIPE, "env": environment(), "text": True}

    def hears() -> None:  # what runs the tests in the background may have taught its children to ignore it
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    with subprocess.Popen(command, preexec_fn=hears, **options) as process:
        deadline = time.monotonic() + 100.0
        while not list((tmp_path / "drawn").rglob("blender.txt")) and time.monotonic() < deadline:
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        _, words = process.communicate(timeout=60)
    assert process.returncode == 0 and "cancelled" in words
    assert not list(tmp_path.glob("*.json")) and not list(tmp_path.glob("*.html*"))


def test_a_job_that_is_not_finished(scene: Path, job: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert not (tmp_path / RESULT_FILE).exists()
    assert main(["evaluate", "--job", str(tmp_path), "--truth", str(scene)]) == 2
    assert main(["evaluate", "--job", str(job), "--truth", str(tmp_path)]) == 2
    assert main(["evaluate", "--job", str(job), "--truth", str(scene), "--lpips", str(tmp_path / "none.pth")]) == 2
    words = " ".join(capsys.readouterr().err.split())
    for part in ("holds no finished job", "neither a benchmark scene nor cameras", "holds no tensors"):
        assert part in words


def lines(*values: list[tuple[float, float]]) -> list[chart.Line]:
    return [chart.Line(name=f"<{index}>", points=points) for index, points in enumerate(values)]


def test_a_chart_shows_every_point_in_its_place() -> None:
    drawn = chart.drawn(
        chart.Chart(title='a "b" <c>', x_label="x", y_label="y", lines=lines([(0, 1), (5, 3)], [(0, 2), (10, 2)]))
    )
    found = Elements(drawn)
    assert found.open == [] and found.of("svg")[0]["aria-label"] == 'a "b" <c>'
    corners = [polyline["points"] for polyline in found.of("polyline")][:2]
    places = [[tuple(map(float, pair.split(","))) for pair in (text or "").split()] for text in corners]
    assert places[0][0][0] == places[1][0][0] == 52.0 and places[1][1][0] == 628.0
    assert places[0][1][0] == pytest.approx(340.0) and places[0][0][1] > places[1][0][1] > places[0][1][1]
    assert found.words.endswith("<0><1>")


@pytest.mark.parametrize(
    "values", [[(0.0, 5.0), (1.0, 5.0)], [(0.0, -1e9), (1.0, 1e9)], [(0.0, 1e-9), (1e6, 2e-9)], [(0.0, 0.0), (1.0, 0.0)]]
)
def test_charts_of_any_range(values: list[tuple[float, float]]) -> None:
    found = Elements(chart.drawn(chart.Chart(title="t", x_label="x", y_label="y", lines=lines(values))))
    numbers = [float(circle[axis] or "nan") for circle in found.of("circle") for axis in ("cx", "cy")]
    assert len(numbers) == 4 and np.isfinite(numbers).all() and min(numbers) >= 0.0 and max(numbers) <= chart.WIDTH


def test_a_chart_of_nothing_is_nothing() -> None:
    for points in ([], [(1.0, 2.0)]):
        assert chart.drawn(chart.Chart(title="t", x_label="x", y_label="y", lines=lines(points))) == ""


def test_a_difference_has_a_sign() -> None:
    values = np.array([[1.0, 0.0, -0.5]])
    shown = pictures.signed(values, full=0.5)
    assert shown[0, 0, 0] > shown[0, 0, 2] and shown[0, 2, 2] > shown[0, 2, 0] and not shown[0, 1].any()
    assert pictures.signed(values, full=0.0).max() == 0.0 == pictures.grey(values, full=0.0).max()
    assert np.array_equal(pictures.upright(np.array([[1, 2], [3, 4]])), [[2, 4], [1, 3]])


def test_figures_in_words() -> None:
    assert markup.number(None) == "&ndash;" and markup.number(-1.5, 1) == "&minus;1.5"
    assert "good" in markup.lead(0.5) and "bad" in markup.lead(-0.5) and "good" in markup.lead(-0.5, is_lower_better=True)
    assert markup.lead(0.001) == "0.00" and "&#9650;" in markup.lead(-0.1, is_lower_better=True)
    assert "&lt;b&gt;" in markup.paragraph("<b>")
