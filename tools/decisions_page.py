"""Makes docs/decisions.md: what is decided from a clip, what that is worth, and how near estimates come.

    python -m tools.decisions_page

Figures are from docs/results/decisions.json and docs/results/estimates.json, thresholds from the code itself.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from backend.fit.scene import LEAST_TURN
from backend.fit.survey import DETAIL_SHARES, MAX_FRAMES, MAX_SIDE
from backend.io.atomic import write_text
from backend.stages.inspect import LEAST_DETAIL_DB, LEAST_ONE_HUE_DB, PARTICLES_A_PIXEL

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = DOCS / "decisions.md"
FIGURES = {"input_smoke_db": "input, smoke", "nvs_db": "NVS", "side_db": "side"}


def decided() -> list[tuple[str, str, str, str]]:
    """Name, what it chooses, by what, and the setting with which the user chooses."""
    shares = ", ".join(f"{share:g}" for share in DETAIL_SHARES)
    return [
        ("extraction", "alpha, on black or matte", "the alpha channel; how much of the picture is black", "extraction.mode"),
        ("camera", "given, still, or moving (with a warning)", "how far the background shifts", "cameras.mode"),
        (
            "resolution",
            "the settings' size, or less",
            f"reduced to {shares} and brought back, pictures stay the same to {LEAST_DETAIL_DB:.0f} dB",
            "frames.working_size",
        ),
        (
            "depth",
            "what the prior sees, or smoke as deep as it is wide",
            f"the camera goes {math.degrees(LEAST_TURN):.0f} degrees around the smoke or more",
            "volume.as_deep_as_wide",
        ),
        (
            "color",
            "three channels, or one hue",
            f"with one hue the pictures stay the same to {LEAST_ONE_HUE_DB:.0f} dB",
            "visual.color",
        ),
        (
            "particles",
            "the settings' number, or fewer",
            f"{PARTICLES_A_PIXEL:g} for each pixel of smoke in the fullest frame",
            "visual.num_particles",
        ),
    ]


def page() -> str:
    return "\n".join(_lines()).rstrip() + "\n"


def _lines() -> Iterator[str]:
    yield "# What a clip requires, and what a job will take"
    yield ""
    yield "Made by `python -m tools.decisions_page` from `docs/results/decisions.json` and `docs/results/estimates.json`."
    yield ""
    yield (
        f"`inspect`, the panel's *Estimate* and the first stage of every job look at up to {MAX_FRAMES} frames of the clip at "
        f"{MAX_SIDE} px and decide what it requires. A decision gives a setting its value; the job follows it and keeps it, with "
        "its reason and what was measured, in `decisions.json`. A setting that the user chose stands (`--set KEY=VALUE`, or a "
        "value in the panel that is not the preset's), and the decision says so. `--set follow_clip=false` decides nothing."
    )
    yield ""
    yield from table(("decision", "chooses", "by", "decide it yourself with"), [(*row[:3], f"`{row[3]}`") for row in decided()])
    yield from _worth(load("decisions"))
    yield from _estimates(load("estimates"))


def load(name: str) -> dict[str, Any]:
    return json.loads((DOCS / "results" / f"{name}.json").read_text(encoding="utf-8"))


def _worth(results: dict[str, Any]) -> Iterator[str]:
    first, stop = results["frames"]
    threads = "one thread" if results["threads"] == 1 else f"{results['threads']} threads"
    yield "## What each decision is worth"
    yield ""
    yield (
        f"`python -m benchmarks.decisions --out DIR --page`: the benchmark's scenes, frames {first} to {stop - 1} where a row "
        f"names no others, preset `{results['preset']}`, {threads}; as decided, and with one decision at a time made the other "
        "way. Differences to the scene as decided: PSNR in dB (positive: the other way is better) and processor time. Nothing "
        "was chosen by those with *."
    )
    yield ""
    made = [variant for variant in results["variants"] if variant["is_made"]]
    rows = [_row(results, variant) for variant in made]
    head = ("decision", "the other way", *(f"{name}, dB" for name in FIGURES.values()), "untouched scenes", "time")
    yield from table(head, [row for row in rows if row])
    yield "### Tried, and not made"
    yield ""
    yield (
        "Whether smoke is dense or thin, and whether it stays as it is or changes, were to decide how the optical masses are "
        "fitted. What they would steer makes no difference that depends on the scene, so nothing is decided by them."
    )
    yield ""
    rows = [_row(results, variant) for variant in results["variants"] if not variant["is_made"]]
    yield from table(head, [row for row in rows if row])
    yield "### Every scene"
    yield ""
    yield from table(
        ("scene", "variant", *(f"{name}, dB" for name in FIGURES.values()), "processor s", "decided"),
        [
            _scene_row(cell)
            for cell in sorted(results["cells"], key=lambda cell: (cell["scene"], cell["base"] or "", cell["name"]))
        ],
    )


def _place(cell: dict[str, Any]) -> tuple[str, str, str]:
    return cell["scene"], cell["base"] or "", cell["name"]


def differences(results: dict[str, Any], variant: dict[str, Any]) -> list[tuple[bool, dict[str, float], float]]:
    """Of each scene: whether it is untouched, what the other way changes in each figure, and its time over the decided one's."""
    cells = {(cell["scene"], cell["name"]): cell for cell in results["cells"]}
    found = []
    for (scene, name), cell in cells.items():
        base = cells.get((scene, variant["base"]))
        if name != variant["name"] or base is None:
            continue
        shared = [figure for figure in FIGURES if figure in cell["scores"] and figure in base["scores"]]
        change = {figure: cell["scores"][figure] - base["scores"][figure] for figure in shared}
        found.append((cell["untouched"], change, cell["cpu_seconds"] / base["cpu_seconds"] - 1.0))
    return found


def _row(results: dict[str, Any], variant: dict[str, Any]) -> tuple[str, ...] | None:
    found = differences(results, variant)
    if not found:
        return None
    tuned, untouched = [item for item in found if not item[0]], [item for item in found if item[0]]
    cells = [_mean_of(tuned, figure) for figure in FIGURES]
    others = " / ".join(_mean_of(untouched, figure) for figure in FIGURES)
    time = f"{100.0 * mean(item[2] for item in found):+.0f} %"
    return (variant["decision"], variant["question"], *cells, others, time)


def _mean_of(found: Sequence[tuple[bool, dict[str, float], float]], figure: str) -> str:
    values = [change[figure] for _, change, _ in found if figure in change]
    return f"{mean(values):+.2f}" if values else "-"


def _scene_row(cell: dict[str, Any]) -> tuple[str, ...]:
    figures = [f"{cell['scores'][figure]:.2f}" if figure in cell["scores"] else "-" for figure in FIGURES]
    chosen = ", ".join(str(item["value"]) for item in cell["decisions"].values()) if cell["base"] is None else ""
    mark = "*" if cell["untouched"] else ""
    return (f"{cell['scene']}{mark}", cell["name"], *figures, f"{cell['cpu_seconds']:.1f}", chosen)


def _estimates(results: dict[str, Any]) -> Iterator[str]:
    pairs = results["pairs"]
    told = [pair for pair in pairs if not pair["is_fitted"]]
    within = sum(1.0 / results["factor"] <= pair["ratio"] <= results["factor"] for pair in told)
    yield "## How near the estimates come"
    yield ""
    yield (
        "Some seconds of the real kernels, measured once for each version and machine and kept in the user's cache folder "
        "(`wildsmoke/machine.json`), times what the clip and the settings ask for, with coefficients from jobs on the bundled "
        "clip and benchmark scenes; decoding and extraction are timed on the clip itself. `python -m benchmarks.estimates --out "
        f"DIR --clips FILE ... --fit --page`. Of {len(told)} jobs on clips that nothing was fitted to, {within} took what was "
        f"estimated within a factor of {results['factor']:g}; the largest error is a factor of "
        f"{max(max(pair['ratio'], 1.0 / pair['ratio']) for pair in told):.2f}."
    )
    yield ""
    yield (
        "Seconds are of the processor where jobs ran in one thread on a machine that was busy with other work; `wall` is what "
        "passed. Once a job runs, what is over corrects what is left."
    )
    yield ""
    order = sorted(pairs, key=lambda pair: (pair["is_fitted"], pair["clip"], pair["preset"], *sorted(pair["settings"].values())))
    yield from table(
        (
            "clip",
            "preset",
            "frames",
            "settings",
            "prior",
            "estimated s",
            "took s",
            "ratio",
            "wall s",
            "estimated GiB",
            "took GiB",
            "fitted to",
        ),
        [
            (
                pair["clip"],
                pair["preset"],
                str(pair["num_frames"]),
                ", ".join(f"{key}={value}" for key, value in pair["settings"].items()) or "-",
                "yes" if pair["has_prior"] else "no",
                f"{pair['estimated_seconds']:.1f}",
                f"{pair['measured_seconds']:.1f}",
                f"{pair['ratio']:.2f}",
                f"{pair['wall_seconds']:.0f}",
                f"{pair['estimated_gib']:.2f}",
                f"{pair['measured_gib']:.2f}",
                "yes" if pair["is_fitted"] else "no",
            )
            for pair in order
        ],
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield f"| {' | '.join(head)} |"
    yield f"| {' | '.join('---' for _ in head)} |"
    for row in rows:
        yield f"| {' | '.join(row)} |"
    yield ""


def main() -> None:
    write_text(PAGE, page())


if __name__ == "__main__":
    main()
