"""No figure in docs/extremes.md is typed by hand, none is beyond its bound, and each line's test is there."""

from __future__ import annotations

import ast
import math

from tools import extremes_page


def functions_with_lines() -> set[str]:
    """FILE::TEST of every test of the suite that takes the table."""
    found = set()
    for path in extremes_page.SUITE.glob("test_*.py"):
        for item in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            is_test = isinstance(item, ast.FunctionDef) and item.name.startswith("test_")
            if is_test and "table" in [argument.arg for argument in item.args.args]:
                found.add(f"{path.name}::{item.name}")
    return found


def test_the_page_agrees_with_its_figures() -> None:
    assert extremes_page.PAGE.read_text(encoding="utf-8") == extremes_page.page(extremes_page.load())


def test_the_whole_ranges_were_run() -> None:
    assert extremes_page.load()["range"] == "full"


def test_every_line_has_its_test_and_every_test_its_line() -> None:
    assert {row["test"].partition("[")[0] for row in extremes_page.load()["rows"]} == functions_with_lines()


def test_no_line_is_beyond_its_bound_or_without_a_part() -> None:
    for row in extremes_page.load()["rows"]:
        assert row["worst"] <= row["bound"], row
        assert math.isfinite(row["worst"]), row
        assert row["part"] in extremes_page.PARTS, row
        assert row["quantity"] in extremes_page.PAGE.read_text(encoding="utf-8")
