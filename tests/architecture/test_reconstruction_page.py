"""The page's part on the reconstruction: means, verdicts and marks, from cells whose figures are known."""

from __future__ import annotations

import copy
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks import cost
from tools import reconstruction_page as page

LARGE = 200  # MB
FAKE_BACKEND = f"""#!{sys.executable}
import json, subprocess, sys, time
say = lambda **event: print(json.dumps(event), flush=True)
say(event="hello")
for name in ("frames", "physical"):
    say(event="stage", name=name, skipped=name in sys.argv)
    time.sleep(0.2)
if "fail" in sys.argv:
    say(event="error", message="The clip is empty.")
    sys.exit(2)
work = "x = bytearray({LARGE} * 2**20); x[:] = b'1' * len(x)" + chr(10) + "for i in range(4_000_000): i * i"
if "idle" not in sys.argv:
    subprocess.run([sys.executable, "-c", work], check=True)
say(event="done")
"""


def answers(ours: float, trivial: float, *names: str) -> dict[str, dict[str, float]]:
    keys = ("full_db", "smoke_db", "global_db", "first_db", "middle_db", "last_db")
    return {name: dict.fromkeys(keys, ours if name == "ours" else trivial) for name in ("ours", *names)}


def cell(scene: str, preset: str = "final", method: str = "default", **changes: Any) -> dict[str, Any]:
    scores = {
        "input": answers(33.0, 20.0, "black"),
        "nvs": answers(30.0, 28.0, "copy", "mirror"),
        "side": answers(25.0, 23.0, "copy", "mirror"),
        "back": answers(24.0, 25.0, "copy", "mirror"),
        "future_input": answers(27.0, 24.0, "frozen copy", "frozen reconstruction"),
        "future_nvs": answers(26.0, 25.0, "frozen copy", "frozen reconstruction"),
        "volume": {"correlation": 0.8, "mass_ratio": 1.2, "relative_l2": 0.6, "velocity": {"correlation_up": 0.6}},
        "divergence": {"as_published": 0.5, "corrected": 0.6},
        "buoyancy": {"strength": 1.0, "degrees_from_up": 4.0},
    }
    spent = {
        "seconds": 100.0, "cpu_seconds": 150.0, "peak_gib": 1.0, "stages": {"start": 1.0, "visual": 99.0}, "load": 1.0,
        "threads": 2, "is_resumed": False,
    }  # fmt: skip
    found = {"scene": scene, "preset": preset, "method": method, "untouched": False, "weights": None, "code": "c0de"}
    return {**found, "scores": scores, "cost": spent, **changes}


def verdicts(*cells: dict[str, Any]) -> dict[str, page.Target]:
    every: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for found in cells:
        every.setdefault((found["preset"], found["method"]), []).append(found)
    return {target.title: target for target in page.targets(every)}


def test_means_and_verdicts_by_hand() -> None:
    other = cell("b")
    other["scores"]["side"]["ours"]["full_db"] = 29.0  # 6 dB over the best; the mean is 4
    other["scores"]["volume"]["mass_ratio"] = 0.9  # an error of 0.1, the other's 0.2
    found = verdicts(cell("a"), other)
    expected = {
        "input view, smoke mask, dB": (33.0, "yes"),
        "NVS, first third, dB over the best trivial answer": (2.0, "yes"),
        "side, dB over the best trivial answer": (4.0, "yes"),
        "error of the total mass": (0.15, "no"),
        "velocity correlation, up": (0.6, "no"),
        "velocity correlation, depth": (None, "not measured"),
        "FP (IV), dB over freezing": (3.0, "yes"),
        "mean abs(div v) as published, 1/s": (0.5, "yes"),
        "density correlation over that of the per-frame prior, worst scene": (None, "not measured"),
        "final, seconds": (100.0, "yes"),
        "draft, seconds": (None, "not measured"),
    }
    for title, (value, verdict) in expected.items():
        assert found[title].value == (None if value is None else pytest.approx(value)), title
        assert found[title].verdict == verdict, title


def test_the_worst_scene_decides_against_the_prior() -> None:
    """Of weights that are the cell's own."""
    per_frame = {"weights": "abc", "scenes": {"a": {"cross-section": 0.7}, "b": {"cross-section": 0.81, "network": 0.79}}}
    found = [page.with_per_frame(cell(scene, weights="abcdef"), per_frame) for scene in ("a", "b", "c")]
    target = verdicts(*found)["density correlation over that of the per-frame prior, worst scene"]
    assert target.value == pytest.approx(-0.01) and target.verdict == "no"
    others = [page.with_per_frame(cell("b", weights=weights), per_frame) for weights in (None, "def")]
    assert verdicts(*others)["density correlation over that of the per-frame prior, worst scene"].value is None


def test_densities_of_single_frames_stand_beside_ours(tmp_path: Path) -> None:
    per_frame = {"weights": "abc", "scenes": {"a": {"cross-section": 0.5, "network": 0.75}}}
    own = cell("a", weights="abcdef")
    own["scores"]["prior_volume"] = {"correlation": 0.79}
    text = "\n".join(page.reconstruction(figures(own, cell("b", untouched=True)), tmp_path, per_frame))
    assert "| a | 0.500 | 0.750 | 0.790 | 0.800 |" in text
    assert "| b* | - | - | - | 0.800 |" in text
    assert "Beside densities" not in "\n".join(page.reconstruction(figures(own), tmp_path))


def test_divergence_stands_against_the_published_method() -> None:
    published = cell("a", method="as_published")
    title = "mean abs(div v) corrected, 1/s, against that of `as_published`"
    assert title not in verdicts(cell("a"))
    published["scores"]["divergence"]["corrected"] = 0.55
    assert verdicts(cell("a"), published)[title].verdict == "no"


def test_an_interrupted_job_has_no_times() -> None:
    resumed = cell("b")
    resumed["cost"] = {**resumed["cost"], "seconds": 5.0, "peak_gib": 9.0, "is_resumed": True}
    found = verdicts(cell("a"), resumed)
    assert found["final, seconds"].value == 100.0 and found["peak memory, GiB, largest"].value == 1.0


def figures(*cells: dict[str, Any]) -> dict[str, Any]:
    machine = {"processor": "P", "cores": 2, "memory_gib": 8.0, "system": "Linux"}
    return {"machine": machine, "versions": {"numpy": "2"}, "settings": {}, "cells": copy.deepcopy(list(cells))}


def test_a_section_of_all_and_marks(tmp_path: Path) -> None:
    untouched = cell("b", untouched=True)
    untouched["scores"]["input"]["ours"]["smoke_db"] = 30.0
    (tmp_path / "reconstruction_angle.png").write_bytes(b"")
    text = "\n".join(page.reconstruction(figures(cell("a"), untouched, cell("a", preset="draft")), tmp_path))
    assert "| input view, smoke mask, dB | at least 32 | 31.50 | 30.00 | no |" in text
    assert "| final | default | b* |" in text and "| final | default | a |" in text
    assert "| draft | default | 1 |" in text and "| final | default | 2 |" in text
    assert "| back | a | 24.00 | **25.00** | **25.00** |" in text
    assert text.count("![") == 1 and "images/reconstruction_angle.png" in text
    assert text.index("| draft | default | 1 |") < text.index("| final | default | 2 |")


def test_without_final_there_are_no_verdicts(tmp_path: Path) -> None:
    text = "\n".join(page.reconstruction(figures(cell("a", preset="draft", method="as_published")), tmp_path))
    assert "reached" not in text and "Beside trivial answers" not in text and "| draft | as_published | a |" in text


@pytest.fixture
def fake(tmp_path: Path) -> Path:
    """What stands for Python: whatever it is told to run, it is a backend."""
    script = tmp_path / "python"
    script.write_text(FAKE_BACKEND)
    script.chmod(0o755)
    return script


def test_a_run_costs_what_its_children_cost(fake: Path) -> None:
    """Measured by a small process, as the benchmark is one: the system counts what the measuring one held at the fork."""
    program = f"""
import dataclasses, json, sys
from benchmarks import cost, reconstruction
assert "numpy" not in sys.modules, "the runner is no longer small"
sys.executable = {str(fake)!r}
print(json.dumps([dataclasses.asdict(cost.run_backend(*words)) for words in (["clip"], ["idle", "frames"])]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=cost.CHECKOUT, check=True)
    found, idle = json.loads(done.stdout)
    assert found["peak_gib"] > LARGE / 1024 > 2.0 * idle["peak_gib"]
    assert found["cpu_seconds"] > idle["cpu_seconds"] + 0.05
    assert list(found["stages"]) == ["start", "frames", "physical"]
    assert found["stages"]["frames"] >= 0.19 and found["stages"]["physical"] > idle["stages"]["physical"]
    assert 0.5 * found["seconds"] < sum(found["stages"].values()) < found["seconds"] + 0.1
    assert idle["is_resumed"] and not found["is_resumed"]


def test_a_run_that_fails_says_why(fake: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", str(fake))
    with pytest.raises(RuntimeError, match=r"code 2: The clip is empty"):
        cost.run_backend("fail")
