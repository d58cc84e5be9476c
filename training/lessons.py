"""Lessons on disk, drawn from a library of plumes, a file for each plume:

DIR/0001.npz   images [N, O, h, w], matrices [N, O, 3, 4], strides [N, O], conditions [N, C], source [N, 3], sizes [N, 2],
               density [N, X, Y, Z], velocity [N, 3, X, Y, Z]; float16, matrices float32

.venv/backend/bin/python -m training.lessons --plumes DIR --out DIR --seeds 0:120 [--each 50]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from backend.io.atomic import whole_file
from synthetic.progress import Progress
from training.library import read_plume
from training.samples import draw_lesson

_FAINT = 0.02  # of the usual share: a lesson without smoke teaches nothing


def write_lessons(plume: Path, target: Path, *, seed: int, count: int) -> None:
    """Draw `count` lessons from one plume, or leave the file that is there."""
    if target.exists():
        return
    recording = read_plume(plume)
    drawn = []
    for number in range(10 * count):
        lesson = draw_lesson(recording, np.random.default_rng([seed, number]))
        if lesson.density.max() > _FAINT:
            drawn.append(lesson)
        if len(drawn) == count:
            break
    names = ("images", "matrices", "strides", "conditions", "source")
    arrays = {name: np.stack([getattr(lesson.window, name) for lesson in drawn]) for name in names}
    arrays["sizes"] = np.stack([lesson.size for lesson in drawn])
    arrays["density"] = np.stack([lesson.density for lesson in drawn])
    arrays["velocity"] = np.stack([np.moveaxis(lesson.velocity, -1, 0) for lesson in drawn])
    with whole_file(target) as part, open(part, "wb") as file:
        np.savez(file, **{name: array if name == "matrices" else array.astype(np.float16) for name, array in arrays.items()})


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plumes", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", default="0:120", help="A:B")
    parser.add_argument("--each", type=int, default=50)
    given = parser.parse_args(arguments)
    first, stop = map(int, given.seeds.split(":"))
    given.out.mkdir(parents=True, exist_ok=True)
    progress = Progress(label="draw lessons", total=stop - first)
    for seed in range(first, stop):
        plume = given.plumes / f"{seed:04d}"
        while not (plume / "plume.json").exists():
            time.sleep(5.0)  # it is being simulated
        write_lessons(plume, given.out / f"{seed:04d}.npz", seed=seed, count=given.each)
        progress.step()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
