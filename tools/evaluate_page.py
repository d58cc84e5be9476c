"""The figures in docs/evaluate.md, from docs/results/evaluation.json, which benchmarks.evaluation wrote.

python -m tools.evaluate_page            writes them between their marks
python -m tools.evaluate_page --check    says whether the page still agrees with the file
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

CHECKOUT = Path(__file__).resolve().parent.parent
FIGURES = CHECKOUT / "docs" / "results" / "evaluation.json"
PAGE = CHECKOUT / "docs" / "evaluate.md"
BEGIN, END = "<!-- figures -->\n", "<!-- end of figures -->\n"
VIEWS = {
    "input": "input",
    "nvs": "NVS",
    "side": "side",
    "back": "back",
    "future_input": "FP (IV)",
    "future_nvs": "FP (NV)",
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    before = PAGE.read_text(encoding="utf-8")
    text = with_figures(before, json.loads(FIGURES.read_text(encoding="utf-8")))
    if options.check:
        print("docs/evaluate.md agrees with its figures" if text == before else "out of date: python -m tools.evaluate_page")
        return 0 if text == before else 1
    PAGE.write_text(text, encoding="utf-8")
    return 0


def with_figures(page: str, figures: dict[str, Any]) -> str:
    """The page with what stands between the marks made anew."""
    head, _, rest = page.partition(BEGIN)
    _, _, tail = rest.partition(END)
    return head + BEGIN + section(figures) + END + tail


def section(figures: dict[str, Any]) -> str:
    machine, scenes = figures["machine"], figures["scenes"]
    presets = ", ".join(sorted({f"{row['preset']} {row['method']}" for row in scenes}))
    parts = [
        f"`python -m benchmarks.evaluation --jobs DIR --out WORK --json docs/results/evaluation.json`, of jobs by {presets}; "
        f"{machine['processor']}, {machine['cores']} cores, which other work shared. Sources {figures['code']}. "
        "Nothing was tuned on scenes marked with a star. In brackets: the best trivial answer of that figure.\n",
        pictures(scenes),
        f"Cycles beside the particles that the volumes were made of, in the input view: "
        f"{scenes[0]['relight']['num_frames']} frames of each scene, {scenes[0]['relight']['by']['program']}:\n",
        cycles(scenes),
    ]
    return "\n".join(parts)


def pictures(scenes: list[dict[str, Any]]) -> str:
    rows = []
    for row in scenes:
        for view, title in VIEWS.items():
            if view in row:
                found, trivial = row[view], row[view]["trivial"]
                cells = [f"{found[name]:.{digits}f} ({trivial[name][1]:.{digits}f})" for name, digits in SHOWN.items()]
                flow = f"{found['tof']:.2f} ({found['still']:.2f})" if "tof" in found else "-"
                rows.append([name_of(row), title, *cells, f"{found['change_ratio']:.2f}", flow])
    headings = ["scene", "view", "PSNR, dB", "in smoke, dB", "SSIM", "SSIM in smoke", "dtSSD", "change", "tOF, px (still)"]
    return table(headings, rows)


SHOWN = {"full_db": 2, "smoke_db": 2, "ssim": 3, "smoke_ssim": 3, "dtssd": 4}


def cycles(scenes: list[dict[str, Any]]) -> str:
    rows = []
    for row in scenes:
        found, particles = row["relight"], row["relight"]["particles"]
        rows.append(
            [
                name_of(row),
                f"{found['full_db']:.2f}",
                f"{particles['full_db']:.2f}",
                f"{found['smoke_db']:.2f}",
                f"{particles['smoke_db']:.2f}",
                f"{found['ssim']:.3f}",
                f"{particles['ssim']:.3f}",
                f"{row['divergence']['coverage']:.3f}",
            ]
        )
    headings = ["scene", "Cycles, dB", "particles, dB", "Cycles in smoke, dB", "particles", "Cycles, SSIM", "particles"]
    return table([*headings, "coverage of the divergence"], rows)


def name_of(row: dict[str, Any]) -> str:
    return row["scene"] + ("*" if row["untouched"] else "")


def table(headings: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(headings) + " |", "| " + " | ".join("---" for _ in headings) + " |"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"


if __name__ == "__main__":
    sys.exit(main())
