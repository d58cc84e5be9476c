"""No figure in docs/results.md is typed by hand: it is what tools/results.py makes of the files the benchmarks wrote."""

from __future__ import annotations

import json
import re

import pytest

from tools import results


def test_the_page_agrees_with_its_figures() -> None:
    assert results.PAGE.read_text(encoding="utf-8") == results.page()


def test_the_pictures_of_the_page_are_there_and_small() -> None:
    names = re.findall(r"!\[[^]]*\]\(([^)]+)\)", results.page())
    assert names
    for name in names:
        assert (results.PAGE.parent / name).stat().st_size < 400_000, name


def test_the_reconstruction_is_told_when_and_only_when_it_was_measured() -> None:
    assert ("## Reconstruction" in results.page()) == results.has("reconstruction")
    if results.has("reconstruction"):
        cells = results.load("reconstruction")["cells"]
        for cell in cells:
            mark = "*" if cell["scene"] in ("obstacle_plume", "wind_wisp") else ""
            shown = f"{cell['scores']['input']['ours']['smoke_db']:.2f}"
            assert f"| {cell['preset']} | {cell['method']} | {cell['scene']}{mark} | {shown} |" in results.page()
        assert "by_frame_db" not in json.dumps(cells), "figures of single frames are in the pictures"


def test_motion_by_the_size_of_eddies_is_of_the_jobs_that_are_scored() -> None:
    """Not blurred, it is what `evaluate` says of the same jobs."""
    found = results.load("velocity_scales")
    cells = [cell for cell in results.load("reconstruction")["cells"] if (cell["preset"], cell["method"]) == ("final", "default")]
    assert set(found["scenes"]) == {cell["scene"] for cell in cells}
    for cell in cells:
        assert cell["weights"].startswith(found["weights"])
        assert (cell["scene"] in found["untouched"]) == cell["untouched"]
        for axis, value in found["scenes"][cell["scene"]]["ours, 0"].items():
            assert value == pytest.approx(cell["scores"]["volume"]["velocity"][f"correlation_{axis}"], abs=2e-3)
