"""Whether several Blenders draw the same image: one frame, each layer, twice in each with other random numbers.

    .venv/backend/bin/python -m benchmarks.blender_parity --smoke DIR --out DIR [--json FILE] NAME=PROGRAM NAME=PROGRAM ...

PROGRAM is a Blender binary or the Python of a bpy wheel; DIR holds a VDB file for each frame of the preset. Every Blender is
run through `synthetic/render.py` as a user would run it. The noise of an image is what its two runs differ by, the noise
expected between two Blenders follows from both; a difference of the same size is noise, and means over blocks of 10x10 pixels
show what is left when most of the noise is gone.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from itertools import combinations
from pathlib import Path

import av
import cv2
import numpy as np

_CHECKOUT = Path(__file__).resolve().parents[1]
_SEEDS = (1, 2)
_BLOCK = 10  # px
_LAYERS = {
    "clip": "input/clip/{:04d}.png",
    "plate": "truth/plate/{:04d}.png",
    "smoke": "truth/smoke/{:04d}.png",
    "depth": "truth/depth/{:04d}.exr",
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("blenders", nargs="+", help="NAME=PROGRAM")
    parser.add_argument("--smoke", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scene", default="puff_front")
    parser.add_argument("--preset", default="bench")
    parser.add_argument("--frame", type=int, default=67)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    blenders = dict(entry.split("=", 1) for entry in given.blenders)
    versions = {}
    for name, program in blenders.items():
        for seed in _SEEDS:
            folder = given.out / name / str(seed)
            render(program, given, folder, seed=seed)
            versions[name] = json.loads((folder / "render.json").read_text(encoding="utf-8"))["blender"]
    rows = []
    for layer in _LAYERS:
        images = {name: [picture(given.out / name / str(seed), layer, given.frame) for seed in _SEEDS] for name in blenders}
        rows += [compare(layer, versions[a], versions[b], images[a], images[b]) for a, b in combinations(blenders, 2)]
    for row in rows:
        figures = f"differ {row['difference']:.5f}, noise {row['noise']:.5f}, {row['blocks']:.5f} in blocks"
        print(f"{row['layer']:<6} {row['between']:<24} {figures}")
    if given.json:
        given.json.write_text(json.dumps({"samples": given.samples, "rows": rows}, indent=1) + "\n", encoding="utf-8")
    return 0


def render(program: str, given: argparse.Namespace, folder: Path, *, seed: int) -> None:
    """All layers of the input view of one frame."""
    script = _CHECKOUT / "synthetic" / "render.py"
    starts = [program, str(script)] if "python" in Path(program).name else [program, "-b", "--python", str(script), "--"]
    orders = [given.scene, "--out", str(folder), "--preset", given.preset, "--smoke", str(given.smoke), "--views", "input"]
    orders += ["--frames", f"{given.frame}:{given.frame + 1}", "--samples", str(given.samples), "--seed", str(seed), "--plain"]
    folder.mkdir(parents=True, exist_ok=True)
    done = subprocess.run([*starts, *orders], capture_output=True, text=True, check=False)
    if done.returncode or not (folder / _LAYERS["depth"].format(given.frame)).exists():
        sys.stderr.write(done.stderr[-3000:])
        raise SystemExit(f"{program} did not render.")


def picture(folder: Path, layer: str, frame: int) -> np.ndarray:
    """[H, W, channels] float: sRGB-coded 0..1, opacity the fourth; depth in units of 100 m."""
    path = folder / _LAYERS[layer].format(frame)
    if path.suffix == ".exr":
        with av.open(str(path)) as container:
            return next(container.decode(video=0)).to_ndarray(format="gbrapf32le")[..., :1] / 100
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return image.astype(np.float64) / np.iinfo(image.dtype).max


def compare(layer: str, first: str, second: str, a: list[np.ndarray], b: list[np.ndarray]) -> dict[str, object]:
    """Root mean squares: of what the two Blenders' mean images differ by, of the noise expected in that, and in blocks."""
    difference = 0.5 * (a[0] + a[1] - b[0] - b[1])
    noise = 0.5 * np.sqrt(np.mean((a[0] - a[1]) ** 2) + np.mean((b[0] - b[1]) ** 2))
    height, width = (size // _BLOCK * _BLOCK for size in difference.shape[:2])
    blocks = difference[:height, :width].reshape(height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK, -1).mean((1, 3))
    return {
        "layer": layer,
        "between": f"{first} and {second}",
        "difference": round(float(np.sqrt(np.mean(difference**2))), 6),
        "noise": round(float(noise), 6),
        "blocks": round(float(np.sqrt(np.mean(blocks**2))), 6),
    }


if __name__ == "__main__":
    raise SystemExit(main())
