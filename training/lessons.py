"""Lessons on disk, drawn from a library of plumes, a file for each plume:

DIR/0001.npz   images [N, O, h, w], matrices [N, O, 3, 4], strides [N, O], conditions [N, C], source [N, 3], sizes [N, 2],
               density [N, X, Y, Z], velocity [N, 3, X, Y, Z]; float16, matrices float32

.venv/backend/bin/python -m training.lessons --plumes DIR --out DIR --seeds 0:120 [--each 50]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np

from backend.io.atomic import whole_file
from synthetic.progress import Progress
from training.library import Plume, read_plume
from training.samples import Lesson, draw_lesson

Drawn = TypeVar("Drawn")

_FAINT = 0.02  # of the usual share: a lesson without smoke teaches nothing


def write_lessons(plume: Path, target: Path, *, seed: int, count: int) -> None:
    """Draw `count` lessons from one plume, or leave the file that is there."""
    if target.exists():
        return

    def draw(recording: Plume, generator: np.random.Generator) -> Lesson | None:
        lesson = draw_lesson(recording, generator)
        return lesson if lesson.density.max() > _FAINT else None

    drawn = draw_some(draw, read_plume(plume), seed=seed, count=count)
    names = ("images", "matrices", "strides", "conditions", "source")
    arrays = {name: np.stack([getattr(lesson.window, name) for lesson in drawn]) for name in names}
    arrays["sizes"] = np.stack([lesson.size for lesson in drawn])
    arrays["density"] = np.stack([lesson.density for lesson in drawn])
    arrays["velocity"] = np.stack([np.moveaxis(lesson.velocity, -1, 0) for lesson in drawn])
    with whole_file(target) as part, open(part, "wb") as file:
        np.savez(file, **{name: array if name == "matrices" else array.astype(np.float16) for name, array in arrays.items()})


def draw_some(
    draw: Callable[[Plume, np.random.Generator], Drawn | None], recording: Plume, *, seed: int, count: int
) -> list[Drawn]:
    """The first `count` of a plume that show smoke, each of its own number; fewer where it shows hardly any."""
    tried = (draw(recording, np.random.default_rng([seed, number])) for number in range(10 * count))
    return list(islice((found for found in tried if found is not None), count))


def write_all(arguments: list[str], write: Callable[..., None], *, description: str | None, each: int) -> int:
    """A file of lessons for each plume of a library; write: as `write_lessons`."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plumes", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", default="0:120", help="A:B")
    parser.add_argument("--each", type=int, default=each)
    given = parser.parse_args(arguments)
    first, stop = map(int, given.seeds.split(":"))
    given.out.mkdir(parents=True, exist_ok=True)
    progress = Progress(label="draw lessons", total=stop - first)
    for seed in range(first, stop):
        plume = given.plumes / f"{seed:04d}"
        while not (plume / "plume.json").exists():
            time.sleep(5.0)  # it is being simulated
        write(plume, given.out / f"{seed:04d}.npz", seed=seed, count=given.each)
        progress.step()
    return 0


if __name__ == "__main__":
    sys.exit(write_all(sys.argv[1:], write_lessons, description=__doc__, each=50))
