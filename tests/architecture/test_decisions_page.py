"""No figure of docs/decisions.md is typed by hand, and what it says of decisions and estimates holds for the files."""

from __future__ import annotations

from backend.contract.job import Config, settable_keys
from backend.stages.inspect import KEYS
from tools import decisions_page


def test_the_page_agrees_with_its_figures() -> None:
    assert decisions_page.PAGE.read_text(encoding="utf-8") == decisions_page.page()


def test_every_decision_is_described_and_can_be_made_by_the_user() -> None:
    assert tuple(sorted(row[3] for row in decisions_page.decided())) == tuple(sorted(KEYS))
    assert set(KEYS) <= set(settable_keys(Config()))
    variants = decisions_page.load("decisions")["variants"]
    names = {row[0] for row in decisions_page.decided()}
    assert {variant["decision"] for variant in variants if variant["is_made"]} == names, "each was tried the other way"


def test_estimates_on_clips_that_nothing_was_fitted_to_are_within_the_factor() -> None:
    results = decisions_page.load("estimates")
    told = [pair for pair in results["pairs"] if not pair["is_fitted"]]
    assert len(told) >= 4 and len({pair["clip"] for pair in told}) >= 2
    for pair in told:
        assert 1.0 / results["factor"] <= pair["ratio"] <= results["factor"], (pair["clip"], pair["preset"], pair["ratio"])
        assert (
            pair["ratio"] == round(pair["estimated_seconds"] / pair["measured_seconds"], 3)
            or abs(pair["ratio"] - pair["estimated_seconds"] / pair["measured_seconds"]) < 2e-3
        )


def test_differences_by_hand() -> None:
    def cell(name: str, db: float, seconds: float, base: str | None) -> dict:
        return {"scene": "a", "name": name, "base": base, "untouched": False, "scores": {"nvs_db": db}, "cpu_seconds": seconds}

    results = {"cells": [cell("decided", 30.0, 10.0, None), cell("half", 29.5, 8.0, "decided")]}
    ((untouched, change, time),) = decisions_page.differences(results, {"name": "half", "base": "decided"})
    assert not untouched and change == {"nvs_db": -0.5} and abs(time + 0.2) < 1e-9
