"""docs/results.md from the figures that the benchmarks wrote; nothing in it is typed by hand.

python -m tools.results            writes docs/results.md from docs/results/*.json
python -m tools.results --check    says whether the page still agrees with the figures
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

CHECKOUT = Path(__file__).resolve().parent.parent
FIGURES = CHECKOUT / "docs" / "results"
PAGE = CHECKOUT / "docs" / "results.md"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    text = page()
    if options.check:
        is_same = PAGE.is_file() and PAGE.read_text(encoding="utf-8") == text
        print("docs/results.md agrees with its figures" if is_same else "docs/results.md is out of date: python -m tools.results")
        return 0 if is_same else 1
    PAGE.write_text(text, encoding="utf-8")
    return 0


def page() -> str:
    """The text of docs/results.md."""
    parts = [
        "# What was measured\n",
        "Made by `python -m tools.results` from `docs/results/*.json`, which the named commands wrote. Times are of one "
        "shared machine with two cores that was not always quiet; ratios and memory depend on that less.\n",
        *whole_path(load("whole_path")),
        *input_view(load("view_demo"), load("view_plume"), load("view_wildfire")),
        *forecast(load("forecast_demo"), load("forecast_plume")),
        *rendering(load("render_speed")),
        *physics(load("physics_speed")),
    ]
    return "\n".join(parts)


def load(name: str) -> dict[str, Any]:
    return json.loads((FIGURES / f"{name}.json").read_text(encoding="utf-8"))


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def whole_path(figures: dict[str, Any]) -> list[str]:
    titles = {"demo": "bundled clip", "large": f"1920x1080, {figures['large']['frames']} frames"}
    rows = [
        [titles[name], run["preset"], f"{run['seconds']:.0f}", f"{run['cpu_seconds']:.0f}", f"{run['peak_gib']:.2f}"]
        for name, run in figures.items()
        if name in titles
    ]
    stages = list(figures["demo"]["stages"])
    seconds = [[titles[name], *(f"{figures[name]['stages'][stage]:.1f}" for stage in stages)] for name in titles]
    return [
        "## From video to volume\n",
        "`python -m benchmarks.whole_path --json docs/results/whole_path.json`, from nothing to particles.h5 and the VDB "
        f"sequence; load average {figures['machine']['load']:.1f} at the start.\n",
        table(["clip", "preset", "seconds", "processor seconds", "peak GiB"], rows),
        "Seconds by stage:\n",
        table(["clip", *stages], seconds),
    ]


def input_view(*runs: dict[str, Any]) -> list[str]:
    names = ("clip", "preset", "frames", "extraction", "full_db", "smoke_db", "seconds")
    rows = [[*(str(run[name]) for name in names), ", ".join(run["warnings"]) or "none"] for run in runs]
    return [
        "## Input view, real clips among them\n",
        "`python -m benchmarks.input_view JOB --json FILE`: PSNR in dB of the reconstruction against its own smoke layer, over "
        "the full frame and over the smoke. It says how well what was seen is reproduced, nothing of other angles. The real "
        "clips went through the add-on's operators (`tests/end_to_end/operators_on_clip.py CLIP FOLDER`), the stack plume in "
        "bpy 4.5, the wildfire in bpy 5.2.\n",
        table(["clip", "preset", "frames", "extraction", "full frame dB", "smoke dB", "seconds", "warnings"], rows),
        "Seen in their pictures: the stack plume is passed through untouched and stands where it stood; of the wildfire the "
        "plume is kept with soft edges while terrain and sky stay empty, its thin foot along the skyline included, with a few "
        "bright dashes where the ground shows through; from the side both are as deep as wide, which is the prior's word.\n",
    ]


def forecast(*runs: dict[str, Any]) -> list[str]:
    titles = list(runs[0]["mean_db"])
    rows = [
        [
            run["clip"],
            str(run["fitted"]),
            str(len(run["by_horizon_db"]["forecast"])),
            *(f"{run['mean_db'][t]:.2f}" for t in titles),
        ]
        for run in runs
    ]
    return [
        "## Forecast against trivial answers\n",
        "`python -m benchmarks.forecast_horizon CLIP --json FILE`: PSNR in dB in the input view, on frames that the fit never "
        "saw, against their smoke layer on black (sRGB, full frame).\n",
        table(["clip", "frames fitted", "frames ahead", *titles], rows),
    ]


def rendering(figures: dict[str, Any]) -> list[str]:
    rows = [
        [
            f"{row['gaussians']}",
            f"{row['width']}x{row['height']}",
            f"{row['forward_ms']:.1f}",
            f"{row['backward_ms']:.1f}",
            f"{row['both_fastest_ms']:.1f}",
            f"{row['share_of_peak']:.0%}",
        ]
        for row in figures["rows"]
    ]
    return [
        "## Renderer\n",
        f"`python -m benchmarks.render_speed --json`: {figures['machine']['threads']} threads, load average "
        f"{figures['machine']['load']:.1f}, optical depth with {figures['features']} features; share of the peak of a "
        f"float32 matrix product ({figures['product_gflops']:.0f} Gflop/s) in the same run.\n",
        table(["Gaussians", "size", "forward ms", "backward ms", "both, fastest ms", "share of peak"], rows),
    ]


def physics(figures: dict[str, Any]) -> list[str]:
    names = [name for name in figures["results"][0] if name.endswith("_ms")]
    rows = [
        [str(row["particles"]), *(f"{row[name]['best']:.1f} / {row[name]['median']:.1f}" for name in names)]
        for row in figures["results"]
    ]
    return [
        "## Fluid\n",
        f"`python -m benchmarks.physics_speed`: {figures['threads']} threads, load average {figures['load_average']}; "
        "best / median.\n",
        table(["particles", *(name.replace("_", " ") for name in names)], rows),
    ]


if __name__ == "__main__":
    sys.exit(main())
