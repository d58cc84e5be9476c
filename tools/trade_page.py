"""docs/trade.md: what seconds buy, from docs/results/trade.json that `bench` wrote. Nothing in it is typed by hand.

python -m tools.trade_page            writes docs/trade.md
python -m tools.trade_page --check    says whether the page still agrees with the figures
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from backend.contract.job import PRESETS
from benchmarks.trade_front import COST, MEASURES, SMALLEST, Point, dominating, front, growth_of, noise_of, points_of
from tools.reconstruction_page import shown, table

DOCS = Path(__file__).resolve().parent.parent / "docs"
FIGURES = DOCS / "results" / "trade.json"
GUARD = DOCS / "results" / "guard.json"
PAGE = DOCS / "trade.md"

TITLES = {
    "unseen_db": "unseen views, dB",
    "input_smoke_db": "the clip, dB",
    "vdb_opacity_db": "the clip's opacity in the VDB, dB",
    "density_correlation": "density",
}
COLUMNS = {  # of the tables of settings: score, form
    "input_smoke_db": ("the clip, smoke", ".2f"),
    "nvs_first_db": ("NVS first third", ".2f"),
    "nvs_middle_db": ("middle", ".2f"),
    "nvs_last_db": ("last", ".2f"),
    "side_db": ("side", ".2f"),
    "density_correlation": ("density", ".3f"),
    "velocity_sideways": ("velocity sideways", ".2f"),
    "velocity_up": ("up", ".2f"),
    "velocity_depth": ("depth", ".2f"),
    "future_input_db": ("FP (IV)", ".2f"),
    "future_nvs_db": ("FP (NV)", ".2f"),
}
GUARDED = {
    "input_smoke_db": "the clip, smoke",
    "nvs_db": "NVS",
    "side_db": "side",
    "future_input_db": "FP (IV)",
    "density_correlation": "density",
    "vdb_opacity_db": "the clip's opacity in the VDB",
    "vdb_correlation": "density of the VDB",
}
EXPORT_COLUMNS = {
    "vdb_opacity_db": ("the clip's opacity in the VDB", ".2f"),
    "vdb_correlation": ("density of the VDB", ".3f"),
    "vdb_mib_a_frame": ("MiB a frame", ".2f"),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    text = page(*read())
    if options.check:
        is_same = PAGE.is_file() and PAGE.read_text(encoding="utf-8") == text
        print("docs/trade.md agrees with its figures" if is_same else "docs/trade.md is out of date: python -m tools.trade_page")
        return 0 if is_same else 1
    PAGE.write_text(text, encoding="utf-8")
    return 0


def read() -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """What bench measured, and the guard's entries."""
    trade, guard = (json.loads(path.read_text(encoding="utf-8")) for path in (FIGURES, GUARD))
    return trade, guard


def page(results: Mapping[str, Any], entries: Sequence[Mapping[str, Any]]) -> str:
    cells = results["cells"]
    noise = noise_of(cells)
    points = whole(results)
    return "\n".join(
        [
            "# Speed against accuracy\n",
            how(results),
            "## Presets\n",
            *presets(points, noise),
            *trivial(results["trivial"]),
            *([PICTURE_FRONT] if (DOCS / "images" / "trade_front.png").is_file() else []),
            "## The front\n",
            *fronts(points),
            "## How cost grows\n",
            *growths(results),
            *([PICTURE_SWEEPS] if (DOCS / "images" / "trade_sweeps.png").is_file() else []),
            "## One setting at a time\n",
            *settings(results),
            "## What is noise\n",
            *noises(noise, len({cell["scene"] for cell in cells})),
            "## The guard\n",
            *guarded(entries),
        ]
    )


PICTURE_FRONT = "![Accuracy over processor seconds](images/trade_front.png)\n"
PICTURE_SWEEPS = "![Cost and gain of one setting at a time](images/trade_sweeps.png)\n"


def how(results: Mapping[str, Any]) -> str:
    cells, machine = results["cells"], results["machine"]
    scenes = sorted({cell["scene"] for cell in cells})
    first, stop = next(cell["frames"] for cell in cells if cell["name"] in PRESETS)
    loads = [cell["load"] for cell in cells]
    versions = ", ".join(f"{name} {number}" for name, number in results["versions"].items())
    codes, weights = (" and ".join(sorted({cell[name][:12] for cell in cells})) for name in ("code", "weights"))
    return (
        f"`python3 wildsmoke.py bench --out DIR --page`: {len(cells)} jobs on the frames {first} to {stop - 1} of "
        f"{' and '.join(scenes)}, which presets are tuned on; the five scenes in full are in [What was measured](results.md). "
        "Fitted from smoke on black with the true cameras, scored on few frames of each view. Short clips that begin in the "
        "middle of the smoke are harder than whole ones, so only differences count here.\n\n"
        "Costs are processor seconds on one thread: they depend less than the clock on what else a machine does. Work that "
        "two jobs have in common was done once and counts for both; the inspection is left out, because most of it is "
        "the timing of the machine, which is done once. "
        f"Machine: {machine['processor']}, {machine['cores']} cores, {machine['memory_gib']:.0f} GiB, {machine['system']}, "
        f"not quiet (load average {min(loads):.1f} to {max(loads):.1f} at the starts), so that ratios say more than seconds. "
        f"{versions}; sources {codes}, the prior's weights {weights}.\n\n"
        "Smoothing length, rest density and time step are no settings: they follow from the particles' spacing.\n"
    )


def whole(results: Mapping[str, Any]) -> dict[str, Point]:
    """The trials that were measured on all scenes."""
    scenes = {cell["scene"] for cell in results["cells"]}
    frames = next(cell["frames"] for cell in results["cells"] if cell["name"] in PRESETS)
    points = points_of(results["cells"], frames=frames)
    return {name: point for name, point in points.items() if point.cells.keys() == scenes}


def presets(points: Mapping[str, Point], noise: Mapping[str, float]) -> list[str]:
    rows = []
    for name in PRESETS:
        point = points[name]
        stages = {stage for cell in point.cells.values() for stage in cell["stages"]}
        costs = {stage: _mean_stage(point, stage) for stage in stages}
        dearest = ", ".join(f"{stage} {costs[stage]:.0f}" for stage in sorted(costs, key=lambda stage: -costs[stage])[:3])
        peak = max(cell["peak_gib"] for cell in point.cells.values())
        better = dominating(point, rivals(name, points), noise)
        measures = [f"{point.mean(name):{'.3f' if 'correlation' in name else '.2f'}}" for name in MEASURES]
        verdict = "yes" if not better else f"no: {setting(better[0].name)}"
        rows.append([name, f"{point.cost:.0f}", dearest, f"{peak:.2f}", *measures, verdict])
    head = ["preset", "processor s", "of these", "peak GiB", *TITLES.values(), "on the front"]
    words = (
        "A preset is off the front where something that was measured is nowhere worse and somewhere better, both by more than "
        "noise: in cost, in views that were never seen (the mean of NVS and side), in the clip itself, "
        "in its opacity through the exported volumes, in density. Settings stand as they are here; that a preset lets the clip "
        "decide some of them (`follow_clip=true`) makes it no other preset.\n"
    )
    return [table(head, rows), words]


def rivals(preset: str, points: Mapping[str, Point]) -> list[Point]:
    """What a preset is compared with: all but itself where it lets the clip decide, which is the same preset."""
    return [point for name, point in points.items() if name != f"{preset} follow_clip=true"]


def trivial(found: Mapping[str, Mapping[str, float]]) -> list[str]:
    """What a reconstruction must be better than."""
    if not found:
        return []
    columns = {"nvs_copy_db": "NVS", "nvs_mirror_db": "NVS, mirrored", "side_copy_db": "side", "side_mirror_db": "side, mirrored"}
    rows = [[scene, *(shown(scores.get(name), ".2f") for name in columns)] for scene, scores in found.items()]
    return ["The input picture itself in the other views, dB:\n", table(["scene", *columns.values()], rows)]


def fronts(points: Mapping[str, Point]) -> list[str]:
    parts = ["What nothing cheaper reaches, by the means alone:\n"]
    for measure in MEASURES:
        form = ".3f" if "correlation" in measure else ".2f"
        rows = [[f"{p.cost:.1f}", f"{p.mean(measure):{form}}", setting(p.name)] for p in front(points.values(), measure)]
        parts.append(table(["processor s", TITLES[measure], "settings"], rows))
    return parts


def growths(results: Mapping[str, Any]) -> list[str]:
    rows = []
    for sweep in results["sweeps"]:
        if not sweep["is_exponent"]:
            continue
        cells = results["cells"]
        whole_job, stage = growth_of(sweep, cells), growth_of(sweep, cells, sweep["stage"]) if sweep["stage"] else None
        if whole_job is None:
            continue
        values = [value for value, name in sweep["points"] if any(cell["name"] == name for cell in cells)]
        both = [f"{found.exponent:.2f} ± {found.error:.2f}" if found else "-" for found in (whole_job, stage)]
        rows.append([title(sweep), f"{values[0]} to {values[-1]}", both[0], sweep["stage"] or "-", both[1], str(whole_job.count)])
    words = (
        "Processor seconds grow as setting to the power of this: least squares of the logarithms, a factor of its own for each "
        "scene, with the standard error; values of 0 are left out.\n"
    )
    return [words, table(["setting", "range", "whole job", "stage", "its stage", "jobs"], rows)]


def settings(results: Mapping[str, Any]) -> list[str]:
    parts = ["Means over the scenes that all values of a setting were measured on; `(base)` marks the preset's own value.\n"]
    for sweep in results["sweeps"]:
        columns = COLUMNS | (EXPORT_COLUMNS if sweep["stage"] == "export" else {})
        cells = {name: [cell for cell in results["cells"] if cell["name"] == name] for _, name in sweep["points"]}
        scenes = [{cell["scene"] for cell in found} for found in cells.values() if found]
        common = set.intersection(*scenes) if scenes else set()
        rows = []
        for value, name in sweep["points"]:
            found = [cell for cell in cells[name] if cell["scene"] in common]
            if not found:
                continue
            costs = [_mean([cell[key] for cell in found]) for key in ("cpu_seconds", "seconds")]
            stage = _mean([cell["stages"][sweep["stage"]]["cpu_seconds"] for cell in found if sweep["stage"] in cell["stages"]])
            scores = [_mean([cell["scores"][key] for cell in found if key in cell["scores"]]) for key in columns]
            forms = zip(scores, (form for _, form in columns.values()), strict=True)
            cost = [shown(costs[0], ".1f"), shown(stage, ".1f"), shown(costs[1], ".0f")]
            peak = f"{max(cell['peak_gib'] for cell in found):.2f}"
            marked = value + (" (base)" if name == sweep["base"] else "")
            rows.append([marked, str(len(found)), *cost, peak, *(shown(score, form) for score, form in forms)])
        if len(rows) > 1:
            heads = ["processor s", f"of {sweep['stage']}" if sweep["stage"] else "-", "seconds", "peak GiB"]
            parts += [f"### {title(sweep)}\n", table(["value", "scenes", *heads, *(name for name, _ in columns.values())], rows)]
    return parts


def noises(noise: Mapping[str, float], num_scenes: int) -> list[str]:
    rows = []
    for name in MEASURES:
        form = ".4f" if "correlation" in name else ".3f"
        rows.append([TITLES[name], f"{noise[name]:{form}}", f"{SMALLEST[name]:g}"])
    rows.append(["processor seconds, relative", f"{noise[COST]:.3f}", f"{SMALLEST[COST]:.3f}"])
    words = (
        "Standard deviation between runs of the presets that differ in their random numbers alone, pooled. A difference between "
        f"two settings, in the mean of {num_scenes} scenes, counts where it is more than two standard errors and more than the "
        "smallest that anyone would choose a setting for.\n"
    )
    return [words, table(["figure", "deviation", "smallest that counts"], rows)]


def guarded(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    words = (
        "The ordinary tests run two small jobs and fail where a score falls by more than 0.3 dB or 0.01, or counted work rises "
        "by more than 15 %, against the last entry of `docs/results/guard.json`. An entry is made on purpose, with its reason: "
        '`python -m benchmarks.guard --add "Reason."`.\n'
    )
    parts = [words]
    for case in entries[-1]["cases"] if entries else ():
        kinds = list(entries[-1]["cases"][case]["work"])
        rows = []
        for entry in entries:
            scores, work = entry["cases"][case]["scores"], entry["cases"][case]["work"]
            figures = [shown(scores.get(name), ".3f" if "correlation" in name else ".2f") for name in GUARDED]
            rows.append([entry["reason"], entry["code"], *figures, *(f"{work.get(kind, 0) / 1e6:.1f}" for kind in kinds)])
        named = [f"{kind.replace('_', ' ')}, million" for kind in kinds]
        parts += [f"Small job {case}:\n", table(["reason", "sources", *GUARDED.values(), *named], rows)]
    return parts


def title(sweep: Mapping[str, Any]) -> str:
    return f"{sweep['key']}{', without the prior' if 'use_prior' in sweep['base'] else ''}"


def setting(name: str) -> str:
    """The name of a trial as code, so that no underscore is taken for emphasis."""
    return f"`{name}`"


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _mean_stage(point: Point, stage: str) -> float:
    return sum(cell["stages"].get(stage, {}).get("cpu_seconds", 0.0) for cell in point.cells.values()) / len(point.cells)


if __name__ == "__main__":
    raise SystemExit(main())
