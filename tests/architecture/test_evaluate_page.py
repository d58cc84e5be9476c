"""What docs/evaluate.md says: figures of their file, options of the command, measures that a result holds."""

from __future__ import annotations

import argparse
import json
import re

from backend import evaluation
from tools import evaluate_page


def page() -> str:
    return evaluate_page.PAGE.read_text(encoding="utf-8")


def test_the_figures_are_those_of_the_file() -> None:
    figures = json.loads(evaluate_page.FIGURES.read_text(encoding="utf-8"))
    assert evaluate_page.with_figures(page(), figures) == page(), "python -m tools.evaluate_page"
    assert {row["scene"] for row in figures["scenes"] if row["untouched"]} == {"obstacle_plume", "wind_wisp"}
    for row in figures["scenes"]:
        assert f"{row['nvs']['ssim']:.3f} ({row['nvs']['trivial']['ssim'][1]:.3f})" in page()


def test_no_figure_stands_outside_the_marks() -> None:
    """Decibels and shares are measured; numbers of the method are whole or of a formula."""
    head = page().partition(evaluate_page.BEGIN)[0]
    assert not re.search(r"\d+\.\d+ ?(dB|s|px)\b", head)


def test_every_option_is_named() -> None:
    parser = argparse.ArgumentParser()
    evaluation.add_options(parser)
    for name in (name for action in parser._actions for name in action.option_strings if name.startswith("--")):
        assert name == "--help" or name in page(), name
