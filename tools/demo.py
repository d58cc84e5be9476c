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
    for step in steps:
        if not sys.stdout.isatty() and "reconstruct" in step:
            print("wildsmoke: reconstructing; progress in a terminal only", flush=True)
        code = subprocess.run(step, cwd=CHECKOUT, env={**os.environ, "PYTHONPATH": str(CHECKOUT)}, check=False).returncode
        if code:
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
