"""No figure in docs/results.md is typed by hand: it is what tools/results.py makes of the files the benchmarks wrote."""

from __future__ import annotations

from tools import results


def test_the_page_agrees_with_its_figures() -> None:
    assert results.PAGE.read_text(encoding="utf-8") == results.page()
