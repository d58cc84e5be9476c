"""What `evaluate` says of finished jobs of the benchmark set besides PSNR: structure, time, motion, Cycles.

    python -m benchmarks.evaluation --jobs DIR --out WORK [--from SET] [--json FILE]

DIR holds a finished job for each scene, as benchmarks.reconstruction leaves them in OUT/PRESET/METHOD. WORK keeps the scores of
every scene and the pictures that Cycles drew; what is there is not made again. Needs Blender, as `evaluate --relight` does.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from backend.contract.result import RESULT_FILE
from backend.io.atomic import write_text
from backend.score.compare import OURS, best_trivial
from benchmarks.cost import CHECKOUT
from benchmarks.reconstruction import SETS, UNTOUCHED, code_digest, machine

VIEWS = ("input", "nvs", "side", "back", "future_input", "future_nvs")
NUM_DRAWN = 3  # frames that Cycles draws of a scene
FIGURES = ("full_db", "smoke_db", "ssim", "smoke_ssim", "dtssd", "change_ratio")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--from", dest="source", type=Path, default=SETS)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    scenes = sorted(
        path.parent.name for path in given.jobs.glob(f"*/{RESULT_FILE}") if (given.source / path.parent.name).is_dir()
    )
    rows = [row_of(scene, scored(given.jobs / scene, given.source / scene, given.out)) for scene in scenes]
    if not rows:
        print(f"{given.jobs} holds no finished job of a scene in {given.source}", file=sys.stderr)
        return 1
    text = json.dumps({"machine": machine(), "code": code_digest(), "scenes": rows}, indent=1, allow_nan=False) + "\n"
    if given.json is not None:
        write_text(given.json, text)
    print(text, end="")
    return 0


def scored(job: Path, truth: Path, work: Path) -> dict[str, Any]:
    """The scores of a job, with what Cycles shows."""
    kept = work / f"{truth.name}.json"
    if not kept.exists():
        run(job, truth, "--out", kept, "--relight", work / "drawn", "--relight-frames", NUM_DRAWN)
    return json.loads(kept.read_text(encoding="utf-8"))


def run(job: Path, truth: Path, *options: str | Path | int) -> None:
    """Raises CalledProcessError where it does not come to its end."""
    command = [sys.executable, "-m", "backend", "evaluate", "--job", job, "--truth", truth, *options]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    subprocess.run(list(map(str, command)), check=True, stdout=subprocess.DEVNULL, cwd=CHECKOUT, env=environment)


def row_of(scene: str, scores: dict[str, Any]) -> dict[str, Any]:
    """Ours, and the best trivial answer where one is better than another."""
    row: dict[str, Any] = {"scene": scene, "untouched": scene in UNTOUCHED, "preset": scores["job"]["preset"]}
    row["method"] = scores["job"]["method"]
    for view in VIEWS:
        if view in scores:
            ours = scores[view][OURS]
            row[view] = {figure: ours[figure] for figure in FIGURES}
            row[view]["trivial"] = {figure: best_trivial(scores[view], figure) for figure in FIGURES if figure != "change_ratio"}
            row[view] |= scores["motion"][view]
    row["divergence"] = scores["divergence"]
    row["relight"] = {figure: scores["relight"][OURS][figure] for figure in FIGURES[:4]}
    row["relight"]["particles"] = {figure: scores["relight_particles"][figure] for figure in FIGURES[:4]}
    row["relight"]["by"] = scores["relight_by"]
    row["relight"]["num_frames"] = len(scores["relight"][OURS]["by_frame_db"])
    return row


if __name__ == "__main__":
    sys.exit(main())
