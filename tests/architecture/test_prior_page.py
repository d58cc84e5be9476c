"""What docs/prior.md says of the training is what the training wrote, of the weights that ship."""

from __future__ import annotations

import json
from pathlib import Path

from backend.prior.weights import WEIGHTS

CHECKOUT = Path(__file__).resolve().parents[2]
COLUMNS = ("density1", "density2", "sideways2", "up2", "depth2")


def test_the_page_shows_the_log_of_the_training() -> None:
    page = (CHECKOUT / "docs" / "prior.md").read_text(encoding="utf-8")
    log = (CHECKOUT / "docs" / "results" / "prior_training.jsonl").read_text(encoding="utf-8").splitlines()
    assert len(log) == 8
    for line in log:
        entry = json.loads(line)
        cells = " | ".join(f"{entry[name]:.3f}" for name in COLUMNS)
        assert f"| {entry['passes']} | {cells} |" in page


def test_the_weights_are_small() -> None:
    assert WEIGHTS.stat().st_size < 10_000_000
