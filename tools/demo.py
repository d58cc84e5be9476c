"""The whole path on the bundled clip: reconstruct, .blend, Cycles preview, report. Prints where the results lie."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
CLIP = CHECKOUT / "synthetic" / "samples" / "demo_plume.mp4"


def run(title: str, command: list[str], *, log: Path) -> int:
    """One step: the backend's progress where somebody watches, everything else to the log."""
    is_watched = title == "reconstruct" and sys.stdout.isatty()
    if not is_watched:
        print(f"{title} ...", flush=True)
    with open(log, "a", encoding="utf-8") as output:
        where = None if is_watched else output
        environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
        return subprocess.run(command, cwd=CHECKOUT, env=environment, stdout=where, check=False).returncode


def main() -> int:
    parser = argparse.ArgumentParser(prog="wildsmoke demo", description=__doc__)
    parser.add_argument("--blender-python", required=True, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, default=CHECKOUT / "out" / "demo", help="the job folder")
    parser.add_argument("--preset", default="preview")
    options = parser.parse_args()
    job, began = options.out.resolve(), time.monotonic()
    blend, preview, report = job / "smoke.blend", job / "preview.png", job / "report.png"
    backend = [sys.executable, "-m", "backend"]
    blender = [options.blender_python, str(CHECKOUT / "addon" / "scene" / "build_blend.py")]
    steps = (
        [*backend, "reconstruct", str(CLIP), "--job", str(job), "--preset", options.preset],
        [*backend, "report", "--job", str(job), "--out", str(report)],
        [*blender, "--job", str(job), "--blend", str(blend), "--preview", str(preview)],
    )
    job.mkdir(parents=True, exist_ok=True)
    for title, step in zip(("reconstruct", "report", "Blender"), steps, strict=True):
        code = run(title, step, log=job / "demo.log")
        if code:
            print(f"{title} ended with code {code}; what it printed is in {job / 'demo.log'}", file=sys.stderr)
            return code
    print(f"\ndone in {time.monotonic() - began:.0f} s")
    for title, path in (
        ("particles", job / "particles.h5"),
        ("VDB sequence", job / "vdb"),
        ("Blender file", blend),
        ("Cycles preview", preview),
        ("report", report),
    ):
        print(f"  {title:<15} {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
