"""Gathers what benchmarks.cycles_trade left in a folder and plots it.

    .venv/backend/bin/python -m benchmarks.cycles_trade_figures DIR

Writes docs/results/cycles_trade.json and docs/images/cycles_trade.png; `python -m tools.results` makes the table of it.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from backend.io.atomic import whole_file

_CHECKOUT = Path(__file__).resolve().parents[1]
FIGURES = _CHECKOUT / "docs" / "results" / "cycles_trade.json"
PLOT = _CHECKOUT / "docs" / "images" / "cycles_trade.png"
_COLORS = {"4.5 marching": "tab:blue", "5.2 biased": "tab:orange", "5.2 unbiased": "tab:green"}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    given = parser.parse_args()
    cases = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(given.folder.glob("*.json"))]
    cases.sort(key=lambda case: (case["layer"], case["axis"], case["blender"], not case["is_biased"], case["samples"]))
    with whole_file(FIGURES) as part:
        part.write_text(json.dumps(cases, indent=1) + "\n", encoding="utf-8")
    with whole_file(PLOT) as part:
        draw(cases).savefig(part, format="png", dpi=100, bbox_inches="tight")
    return 0


def kind(case: dict[str, Any]) -> str:
    """Blender and how it goes through smoke."""
    version = ".".join(case["blender"].split(".")[:2])
    if version == "4.5":
        return "4.5 marching"
    return f"{version} {'biased' if case['is_biased'] else 'unbiased'}"


def draw(cases: list[dict[str, Any]]) -> plt.Figure:
    """Error in the smoke over processor seconds; one panel for the clip, the smoke alone, its opacity and the other settings."""
    figure, panels = plt.subplots(2, 2, figsize=(12, 9))
    titles = {"clip": "the clip", "smoke": "smoke alone: its light", "opacity": "smoke alone: its opacity"}
    for panel, (layer, title) in zip(panels.flat, titles.items(), strict=False):
        found = [case for case in cases if case["layer"] == layer and case["axis"] == "samples"]
        for name in sorted({kind(case) for case in found}):
            for is_denoised in (False, True):
                line = [c for c in found if kind(c) == name and (c["is_denoised"] == is_denoised or layer == "opacity")]
                line.sort(key=lambda case: case["samples"])
                if not line or (layer == "opacity" and is_denoised):
                    continue
                panel.plot(
                    [case["cpu_seconds"] for case in line],
                    [case["smoke_error"] for case in line],
                    color=_COLORS.get(name),
                    linestyle="-" if is_denoised or layer == "opacity" else "--",
                    marker="o",
                    markersize=4,
                    label=f"{name}{', denoised' if is_denoised and layer != 'opacity' else ''}",
                )
                for case in line:
                    panel.annotate(str(case["samples"]), (case["cpu_seconds"], case["smoke_error"]), fontsize=7)
        panel.set_title(f"{title}: samples")
        panel.legend(fontsize=8)
    panel = panels.flat[3]
    for axis, key, marker in (("bounces", "bounces", "o"), ("step rate", "step_rate", "s"), ("resolution", "scale", "^")):
        line = [c for c in cases if c["axis"] == axis and c["layer"] == "clip" and kind(c) == "5.2 biased"]
        line.sort(key=lambda case: case[key])
        panel.plot([c["cpu_seconds"] for c in line], [c["smoke_error"] for c in line], marker=marker, label=axis)
        for case in line:
            panel.annotate(f"{case[key]:g}", (case["cpu_seconds"], case["smoke_error"]), fontsize=7)
    panel.set_title("the clip, 5.2 biased, denoised: one setting at a time")
    panel.legend(fontsize=8)
    for panel in panels.flat:
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_xlabel("processor seconds an image, 180x320")
        panel.set_ylabel("error in the smoke (RMS, sRGB 0..1)")
        panel.grid(True, which="both", alpha=0.25)
    figure.tight_layout()
    return figure


if __name__ == "__main__":
    raise SystemExit(main())
