"""Scores beside each other, as `evaluate` writes them. Without numpy, so that pages and runners may read them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

OURS = "ours"
LOWER_IS_BETTER = ("dtssd", "lpips", "st_lpips")


def best_trivial(answers: Mapping[str, Mapping[str, Any]], figure: str, *, kind: str = "") -> tuple[str, float]:
    """Name and value of the trivial answer with the best of a figure, among those whose names begin with `kind`."""
    found = {name: figures[figure] for name, figures in answers.items() if name != OURS and name.startswith(kind)}
    choose = min if figure in LOWER_IS_BETTER else max
    best = choose((name for name, value in found.items() if value is not None), key=lambda name: found[name])
    return best, float(found[best])


def lead(answers: Mapping[str, Mapping[str, Any]], figure: str, *, kind: str = "") -> float | None:
    """How much more ours has of a figure than the best trivial answer, dB; None where it has none."""
    ours = answers[OURS][figure]
    return None if ours is None else float(ours) - best_trivial(answers, figure, kind=kind)[1]
