"""docs/extremes.md from the table that the suite of the extremes writes; nothing in it is typed by hand.

python -m tools.extremes_page            runs the suite over the whole ranges, then writes the figures and the page
python -m tools.extremes_page --file F   runs one file of it again and replaces that file's lines
python -m tools.extremes_page --page     writes the page from the figures that are there
python -m tools.extremes_page --check    says whether the page agrees with the figures
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from tools.reconstruction_page import table

CHECKOUT = Path(__file__).resolve().parent.parent
SUITE = CHECKOUT / "tests" / "extremes"
FIGURES = CHECKOUT / "docs" / "results" / "extremes.json"
PAGE = CHECKOUT / "docs" / "extremes.md"
PARTS = ("Renderer", "Physics", "Fit", "Prior", "Losses", "Forecast, rollout, export", "Files and streams")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", action="store_true")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--file", metavar="F", help="such as test_extremes_export.py")
    options = parser.parse_args()
    if options.check:
        is_same = PAGE.is_file() and PAGE.read_text(encoding="utf-8") == page(load())
        print("docs/extremes.md agrees with its figures" if is_same else "out of date: python -m tools.extremes_page --page")
        return 0 if is_same else 1
    if not options.page and not run(options.file):
        return 1
    PAGE.write_text(page(load()), encoding="utf-8")
    return 0


def run(file: str | None) -> bool:
    """The suite, or one file of it, over the whole ranges; the figures are written if nothing failed."""
    before = load() if file else None
    target = SUITE / file if file else SUITE
    command = [sys.executable, "-m", "pytest", str(target), "--extremes=full", f"--extremes-table={FIGURES}"]
    if subprocess.run(command, cwd=CHECKOUT, check=False).returncode != 0:
        return False
    if before is not None:
        kept = [row for row in before["rows"] if row["test"].partition("::")[0] != file]
        figures = {**before, "rows": kept + load()["rows"]}
        FIGURES.write_text(json.dumps(figures, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return True


def load() -> dict[str, Any]:
    return json.loads(FIGURES.read_text(encoding="utf-8"))


def page(figures: dict[str, Any]) -> str:
    """The text of docs/extremes.md."""
    rows: list[dict[str, Any]] = figures["rows"]
    versions = ", ".join(f"{name} {version}" for name, version in figures["versions"].items())
    parts = [
        "# The extremes\n",
        f"Made by `{figures['command']}` from `docs/results/extremes.json`, which `pytest tests/extremes` wrote: {len(rows)} "
        f"quantities over their {'whole' if figures['range'] == 'full' else 'short'} ranges in {figures['seconds']} s on "
        f"{figures['threads']} thread{'s' if figures['threads'] > 1 else ''} of a shared machine ({versions}).\n",
        "Each line is a test: it fails where the worst value is beyond the bound. By default the suite runs shorter ranges (no "
        "million particles, no 8K); `--extremes=full` asks for these. Besides, hypothesis draws inputs at random (derandomised: "
        "the same ones in every run) over all of them at once, and asks that results and gradients are finite. "
        '"Refused" means: with a sentence on what is wrong, for a person also one on how to mend it; never a crash.\n',
    ]
    for part in PARTS:
        lines = [
            [
                *(plain(row[name]) for name in ("quantity", "tried", "happens", "measure")),
                number(row["worst"]),
                number(row["bound"]),
            ]
            for row in rows
            if row["part"] == part
        ]
        if lines:
            parts += [f"## {part}\n", table(["quantity", "range tried", "what happens", "measure", "worst", "bound"], lines)]
    return "\n".join(parts)


def plain(text: str) -> str:
    """As a cell: a bar would end it."""
    return text.replace("|", r"\|")


def number(value: float) -> str:
    """Two digits, as short as they come."""
    return f"{value:.0f}" if value == round(value) and abs(value) < 1e4 else f"{value:.2g}"


if __name__ == "__main__":
    sys.exit(main())
