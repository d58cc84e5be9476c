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

from tools.reconstruction_page import reconstruction, table

CHECKOUT = Path(__file__).resolve().parent.parent
FIGURES = CHECKOUT / "docs" / "results"
PAGE = CHECKOUT / "docs" / "results.md"
IMAGES = CHECKOUT / "docs" / "images"


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
    per_frame = load("per_frame") if has("per_frame") else None
    parts = [
        "# What was measured\n",
        "Made by `python -m tools.results` from `docs/results/*.json`, which the named commands wrote. Times are of one "
        "shared machine with two cores that was not always quiet; ratios and memory depend on that less.\n",
        *(reconstruction(load("reconstruction"), IMAGES, per_frame) if has("reconstruction") else []),
        *(velocity_scales(load("velocity_scales")) if has("velocity_scales") else []),
        *(tilted_scene(load("tilted_scene")) if has("tilted_scene") else []),
        *whole_path(load("whole_path")),
        *(clip_length(load("clip_length")) if has("clip_length") else []),
        *input_view(load("view_demo"), load("view_plume"), load("view_wildfire")),
        *forecast(load("forecast_demo"), load("forecast_plume")),
        *rendering(load("render_speed")),
        *physics(load("physics_speed")),
        *(cycles_trade(load("cycles_trade")) if has("cycles_trade") else []),
        *(blender_parity(load("blender_parity")) if has("blender_parity") else []),
    ]
    return "\n".join(parts)


def has(name: str) -> bool:
    """Whether it was measured."""
    return (FIGURES / f"{name}.json").is_file()


def load(name: str) -> dict[str, Any]:
    return json.loads((FIGURES / f"{name}.json").read_text(encoding="utf-8"))


def velocity_scales(figures: dict[str, Any]) -> list[str]:
    scenes = figures["scenes"]
    ways = list(next(iter(scenes.values())))
    axes = list(next(iter(next(iter(scenes.values())).values())))
    means = {way: {axis: sum(of[way][axis] for of in scenes.values()) / len(scenes) for axis in axes} for way in ways}
    blurs = [way.removeprefix("ours, ") for way in ways if way.startswith("ours, ")]
    marked = {scene + ("*" if scene in figures["untouched"] else ""): found for scene, found in scenes.items()} | {"mean": means}
    rows = [
        [scene, blur, *(f"{found[f'{way}, {blur}'][axis]:.2f}" for way in ("ours", "sharpness") for axis in axes)]
        for scene, found in marked.items()
        for blur in blurs
    ]
    rays = [[scene, *(f"{found['rays'][axis]:.2f}" for axis in axes)] for scene, found in marked.items()]
    return [
        "## Motion by the size of eddies\n",
        "`python -m benchmarks.velocity_scales --jobs DIR/final/default --json docs/results/velocity_scales.json`: correlation "
        "of velocity inside true smoke, of both sides blurred alike by so many metres (standard deviation; 0: as it is scored "
        "above). Beside it, in the three last columns, what an answer without any error but its sharpness would be scored: the "
        "truth so blurred, against itself.\n",
        table(["scene", "blur, m", *axes, *(f"{axis}, so sharp" for axis in axes)], rows),
        "What an answer would be scored that knows the mean motion on every ray of the camera without error, and nothing of how "
        "it changes along the ray:\n",
        table(["scene", *axes], rays),
    ]


def tilted_scene(figures: dict[str, Any]) -> list[str]:
    rows = [
        [
            row["scene"] + ("*" if row["untouched"] else ""),
            row["preset"],
            f"{row['tilt_degrees']:g}",
            f"{row['strength']:.2f}",
            "-" if row["degrees_from_up"] is None else f"{row['degrees_from_up']:.1f}",
        ]
        for row in figures["rows"]
    ]
    return [
        "## Which way is up\n",
        "`python -m benchmarks.tilted_scene --out DIR --json docs/results/tilted_scene.json`: the world of each scene is turned, "
        "and the learned buoyancy should be within 10 degrees of the turned up.\n",
        table(["scene", "preset", "turned by, degrees", "buoyancy, m/s^2", "off, degrees"], rows),
    ]


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


def clip_length(figures: dict[str, Any]) -> list[str]:
    rows = [
        [
            str(run["frames"]),
            *(f"{run[name]:.0f}" for name in ("seconds", "cpu_seconds")),
            *(f"{1e3 * run[name] / run['frames']:.0f}" for name in ("seconds", "cpu_seconds")),
            *(f"{1e3 * run['stages'][name] / run['frames']:.0f}" for name in ("volume", "physical", "visual", "export")),
            f"{run['peak_gib']:.2f}",
        ]
        for run in figures["rows"]
    ]
    share = [run["cpu_seconds"] / run["frames"] for run in figures["rows"]]
    return [
        "## Longer clips\n",
        "`python -m benchmarks.clip_length --json docs/results/clip_length.json`: a steady plume at "
        f"`{figures['rows'][0]['preset']}`, {figures['rows'][0]['threads']} threads. The dearest frame takes "
        f"{max(share) / min(share):.2f} times the processor time of the cheapest, start of the program included; at most 1.1 "
        "is asked.\n",
        table(
            [
                "frames", "seconds", "processor seconds", "ms a frame", "processor ms a frame",
                *(f"{name}, ms a frame" for name in ("volume", "physical", "visual", "export")), "peak GiB",
            ],
            rows,
        ),
    ]  # fmt: skip


def input_view(*runs: dict[str, Any]) -> list[str]:
    names = ("clip", "preset", "frames", "extraction", "full_db", "smoke_db", "seconds")
    rows = [[*(str(run[name]) for name in names), ", ".join(run["warnings"]) or "none"] for run in runs]
    return [
        "## Input view, real clips among them\n",
        "`python -m benchmarks.input_view JOB --json FILE`: PSNR in dB of the reconstruction against its own smoke layer, over "
        "the full frame and over the smoke. It says how well what was seen is reproduced, nothing of other angles. The real "
        "clips went through the add-on's operators (`tests/end_to_end/operators_on_clip.py CLIP FOLDER`), in bpy 4.5.\n",
        table(["clip", "preset", "frames", "extraction", "full frame dB", "smoke dB", "seconds", "warnings"], rows),
        "Seen in their pictures: the stack plume is passed through untouched and stands where it stood; of the wildfire the "
        "plume is kept with soft edges while terrain and sky stay empty, its thin foot along the skyline included, with a few "
        "bright dashes where the ground shows through; from the side both are as deep as wide, for no still camera shows more.\n",
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
            f"{row['twin_ratio']:.0f}",
        ]
        for row in figures["rows"]
    ]
    return [
        "## Renderer\n",
        f"`python -m benchmarks.render_speed --json`: {figures['machine']['threads']} threads, load average "
        f"{figures['machine']['load']:.1f}, optical depth with {figures['features']} features; share of the peak of a "
        f"float32 matrix product ({figures['product_gflops']:.0f} Gflop/s) in the same run; and how many times as long the torch "
        "twin takes, which sums every Gaussian in every pixel (timed on a part, and scaled).\n",
        table(["Gaussians", "size", "forward ms", "backward ms", "both, fastest ms", "share of peak", "twin, times"], rows),
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


def cycles_trade(cases: list[dict[str, Any]]) -> list[str]:
    samples = [case for case in cases if case["axis"] == "samples" and case["layer"] != "opacity"]
    rows = [
        [layer, version, "yes" if is_biased else "no", str(number), *cells(found)]
        for layer in ("clip", "smoke")
        for version in sorted({case["blender"] for case in samples})
        for is_biased in (True, False)
        for number in sorted({case["samples"] for case in samples})
        if (
            found := [
                case
                for case in samples
                if (case["layer"], case["blender"], case["is_biased"], case["samples"]) == (layer, version, is_biased, number)
            ]
        )
    ]
    opacity = [
        [case["blender"], str(case["samples"]), f"{case['cpu_seconds']:.1f}", f"{case['smoke_error']:.4f}"]
        for case in cases
        if case["layer"] == "opacity"
    ]
    others = [
        [axis, f"{case[key]:g}", case["layer"], str(case["samples"]), f"{case['cpu_seconds']:.1f}", f"{case['smoke_error']:.4f}"]
        for axis, key in (("bounces", "bounces"), ("step rate", "step_rate"), ("resolution", "scale"))
        for layer in ("clip", "smoke")
        for case in sorted((c for c in cases if c["axis"] == axis and c["layer"] == layer), key=lambda c: c[key])
        if case["blender"].startswith("5")
    ]
    return [
        "## What an image of the benchmark costs in Cycles\n",
        "`python -m benchmarks.cycles_trade`, one frame of `puff_front` at 180x320, against 2048 samples without bias or "
        "denoiser, with 16 bounces. Error: RMS in the smoke, sRGB 0..1; seconds of one processor. Read in "
        "docs/synthetic.md what follows from it.\n",
        "![error over seconds](images/cycles_trade.png)\n",
        table(["layer", "Blender", "biased", "samples", "s plain", "error plain", "s denoised", "error denoised"], rows),
        "The opacity of smoke alone, never denoised:\n",
        table(["Blender", "samples", "s", "error"], opacity),
        "One setting at a time, Blender 5.2, biased, denoised; resolution is brought back to 180x320 before it is compared:\n",
        table(["what", "value", "layer", "samples", "s", "error"], others),
    ]


def cells(cases: list[dict[str, Any]]) -> list[str]:
    """Seconds and error of the image as it is and denoised; a dash where it was not made."""
    made = {case["is_denoised"]: (f"{case['cpu_seconds']:.1f}", f"{case['smoke_error']:.4f}") for case in cases}
    return [text for is_denoised in (False, True) for text in made.get(is_denoised, ("-", "-"))]


def blender_parity(figures: dict[str, Any]) -> list[str]:
    names = ("layer", "between", "difference", "noise", "blocks")
    rows = [[str(row[name]) for name in names] for row in figures["rows"]]
    return [
        "## The same image in every Blender\n",
        f"`python -m benchmarks.blender_parity`: one frame, {figures['samples']} samples, not denoised, twice in each with other "
        "random numbers. RMS of the difference of their means, of the noise expected in it, and of the difference in blocks of "
        "10x10 pixels; sRGB 0..1, depth in units of 100 m.\n",
        table(["layer", "between", "difference", "noise", "in blocks"], rows),
    ]


if __name__ == "__main__":
    sys.exit(main())
