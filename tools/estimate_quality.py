"""backend/estimate/quality.json from docs/results/reconstruction.json: what each preset reaches, mean and spread over scenes.

python -m tools.estimate_quality
"""

from __future__ import annotations

import json
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from backend.contract.job import PRESETS
from backend.estimate.predict import QUALITY_FILE
from backend.io.atomic import write_text

CHECKOUT = Path(__file__).resolve().parents[1]
SOURCE = CHECKOUT / "docs" / "results" / "reconstruction.json"
FIGURES = {"input": "smoke_db", "side": "full_db"}  # view -> figure


def condensed(results: dict[str, Any]) -> dict[str, Any]:
    """Of the default method, the presets that were measured on two scenes or more."""
    presets: dict[str, Any] = {}
    for preset in PRESETS:
        cells = [cell for cell in results["cells"] if cell["preset"] == preset and cell["method"] == "default"]
        if len(cells) < 2:
            continue
        presets[preset] = {}
        for view, figure in FIGURES.items():
            reached = [cell["scores"][view]["ours"][figure] for cell in cells]
            spread = {"mean_db": round(mean(reached), 2), "spread_db": round(stdev(reached), 2), "num_scenes": len(reached)}
            presets[preset][view] = spread
    return {"source": f"docs/results/{SOURCE.name}", "figures": FIGURES, "presets": presets}


def text() -> str:
    """What quality.json should hold."""
    return json.dumps(condensed(json.loads(SOURCE.read_text(encoding="utf-8"))), indent=1) + "\n"


def main() -> None:
    write_text(QUALITY_FILE, text())


if __name__ == "__main__":
    main()
