"""What docs/method.md says of forecasts is what the command found that it names."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from backend.prior.weights import weights_fingerprint
from training.judge_forecast import WAYS

CHECKOUT = Path(__file__).resolve().parents[2]


def test_the_page_shows_how_right_forecasts_are() -> None:
    page = (CHECKOUT / "docs" / "method.md").read_text(encoding="utf-8")
    results = json.loads((CHECKOUT / "docs" / "results" / "forecasts.json").read_text(encoding="utf-8"))
    assert results["weights"] == weights_fingerprint()[:12]
    plumes = [plume for plume in results["plumes"].values() if len(plume) > 1]  # those that show smoke
    for way in WAYS:
        means = {name: np.mean([plume[way][name] for plume in plumes]) for name in ("input_db", "nvs_db", "side_db")}
        assert f"| {way} | {len(plumes)} | {' | '.join(f'{mean:.2f}' for mean in means.values())} |" in page
