"""Plots of what `bench` measured, from docs/results/trade.json: trade_front.png and trade_sweeps.png.

python -m benchmarks.trade_figures [--json FILE] [--out docs/images]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator, ScalarFormatter

from backend.contract.job import PRESETS
from backend.io.atomic import whole_file
from benchmarks.reconstruction import DOCS
from benchmarks.trade_front import MEASURES, Point, front, points_of

FRONT, SWEEPS = "trade_front.png", "trade_sweeps.png"
TITLES = {
    "unseen_db": "views that were never seen (mean of NVS and side), dB",
    "input_smoke_db": "the clip itself, over the smoke, dB",
    "vdb_opacity_db": "its opacity through the exported volumes, dB",
    "density_correlation": "correlation with the true density",
}
# What is nothing should look like nothing.
LEAST_SPAN = {"unseen_db": 1.0, "input_smoke_db": 1.0, "vdb_opacity_db": 1.0, "density_correlation": 0.05}
COLORS = {"draft": "tab:green", "preview": "tab:blue", "final": "tab:red"}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, default=DOCS / "results" / "trade.json")
    parser.add_argument("--out", type=Path, default=DOCS / "images")
    given = parser.parse_args(arguments)
    results = json.loads(given.json.read_text(encoding="utf-8"))
    given.out.mkdir(parents=True, exist_ok=True)
    for name, figure in ((FRONT, draw_front(results)), (SWEEPS, draw_sweeps(results))):
        with whole_file(given.out / name) as part:
            figure.savefig(part, format="png", dpi=90, bbox_inches="tight")
        plt.close(figure)
    return 0


def comparable(results: Mapping[str, Any]) -> dict[str, Point]:
    """The trials that were measured on all scenes, on the frames of the presets."""
    scenes = {cell["scene"] for cell in results["cells"]}
    frames = next(cell["frames"] for cell in results["cells"] if cell["name"] in PRESETS)
    points = points_of(results["cells"], frames=frames)
    return {name: point for name, point in points.items() if point.cells.keys() == scenes}


def draw_front(results: Mapping[str, Any]) -> Figure:
    """Accuracy over processor seconds, a panel for each measure: every trial, and the front."""
    points = comparable(results)
    figure, panels = plt.subplots(1, len(MEASURES), figsize=(20, 5.2))
    for panel, measure in zip(panels, MEASURES, strict=True):
        for name, point in points.items():
            preset, is_preset = name.split()[0], name in PRESETS
            style = {"marker": "*", "s": 260, "zorder": 4, "edgecolor": "black"} if is_preset else {"marker": "o", "s": 22}
            panel.scatter(point.cost, point.mean(measure), color=COLORS[preset], alpha=1.0 if is_preset else 0.7, **style)
            if is_preset:
                panel.annotate(name, (point.cost, point.mean(measure)), xytext=(7, -14), textcoords="offset points")
        best = front(points.values(), measure)
        xs, ys = [point.cost for point in best], [point.mean(measure) for point in best]
        panel.step(xs, ys, where="post", color="black", linewidth=1.0, zorder=1, label="the front")
        panel.margins(0.14)
        panel.autoscale_view()
        low, high = panel.get_ylim()
        more = max(0.5 * (LEAST_SPAN[measure] - (high - low)), 0.0)
        panel.set_ylim(low - more, high + more)
        panel.set_xlabel("processor seconds, geometric mean over scenes")
        panel.set_title(TITLES[measure], fontsize=10)
        panel.set_xscale("log")
        _plain_ticks(panel, [5, 10, 15, 20, 25, 30, 40, 50, 60, 80, 100, 150, 200, 300])
        panel.grid(True, alpha=0.25)
        panel.legend(fontsize=8, loc="best")
    figure.suptitle("Stars: presets. Dots: their neighbours, coloured as the preset that they are changed from.", fontsize=10)
    figure.tight_layout()
    return figure


def draw_sweeps(results: Mapping[str, Any]) -> Figure:
    """One panel for each setting with sizes: the cost beside that of the base, and what it gains over it."""
    swept = [sweep for sweep in results["sweeps"] if sweep["is_exponent"] and len(sweep_rows(sweep, results["cells"])) > 1]
    columns = 4
    rows = -(-max(len(swept), 1) // columns)
    figure, panels = plt.subplots(rows, columns, figsize=(16, 3.7 * rows), squeeze=False)
    for panel in panels.flat[len(swept) :]:
        panel.set_visible(False)
    for panel, sweep in zip(panels.flat, swept, strict=False):
        _draw_sweep(panel, sweep, sweep_rows(sweep, results["cells"]))
    figure.suptitle(
        "Black: processor seconds, times those of the setting marked by the line. "
        "dB gained over it, blue: in views that were never seen, orange: in the clip.",
        fontsize=10,
    )
    figure.tight_layout()
    return figure


def sweep_rows(sweep: Mapping[str, Any], cells: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A row for each value that was measured: value, name, and its cells by scene, on scenes that the base was measured on."""
    found = []
    for value, name in sweep["points"]:
        here = {cell["scene"]: cell for cell in cells if cell["name"] == name}
        found.append({"value": value, "name": name, "cells": here})
    base = next((row for row in found if row["name"] == sweep["base"] and row["cells"]), found[len(found) // 2])
    for row in found:
        row["cells"] = {scene: cell for scene, cell in row["cells"].items() if scene in base["cells"]}
    return [row for row in found if row["cells"]]


def _draw_sweep(panel: Axes, sweep: Mapping[str, Any], rows: list[dict[str, Any]]) -> None:
    base = next((row for row in rows if row["name"] == sweep["base"]), rows[len(rows) // 2])
    sizes = [max(float(row["value"]), 0.5) for row in rows]

    def over_base(read: Any) -> list[float]:
        """Means over each row's own scenes, against the base on the same ones."""
        return [sum(read(cell, base["cells"][scene]) for scene, cell in row["cells"].items()) / len(row["cells"]) for row in rows]

    panel.plot(sizes, over_base(lambda cell, other: cell["cpu_seconds"] / other["cpu_seconds"]), "k.-")
    panel.axvline(max(float(base["value"]), 0.5), color="grey", linewidth=0.8, linestyle=":")
    panel.set_xscale("log")
    panel.set_ylim(bottom=0.0)
    panel.xaxis.set_major_locator(FixedLocator(sizes))
    panel.xaxis.set_minor_locator(NullLocator())
    panel.set_xticklabels([row["value"] for row in rows])
    panel.set_title(sweep["key"] + ("" if "use_prior" not in sweep["base"] else ", without the prior"), fontsize=10)
    gained = panel.twinx()
    for color, keys in (("tab:blue", ("nvs_db", "side_db")), ("tab:orange", ("input_smoke_db",))):

        def gain(cell: Mapping[str, Any], other: Mapping[str, Any], keys: tuple[str, ...] = keys) -> float:
            return sum(cell["scores"][key] - other["scores"][key] for key in keys) / len(keys)

        gained.plot(sizes, over_base(gain), ".-", color=color)
    low, high = gained.get_ylim()
    gained.set_ylim(min(low, -LEAST_SPAN["unseen_db"]), max(high, LEAST_SPAN["unseen_db"]))
    gained.axhline(0.0, color="tab:blue", linewidth=0.5, alpha=0.5)


def _plain_ticks(panel: Axes, places: list[float]) -> None:
    panel.xaxis.set_major_locator(FixedLocator(places))
    panel.xaxis.set_major_formatter(ScalarFormatter())
    panel.xaxis.set_minor_formatter(NullFormatter())


if __name__ == "__main__":
    raise SystemExit(main())
