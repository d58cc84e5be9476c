"""Lessons for the network of shares: what a fit knows of some frames of a library's plumes, and the smoke that is truly there.

DIR/0001_0.npz   of a clip the fields of Known [N, ..]; picture [N, h, w]: the frame's optical depth, and its camera [N, 20] in
                 the grid's own axes, float64; voxel_size [N] m; truth [N, X, Y, Z] 1/m; float16

.venv/backend/bin/python -m training.share_lessons --plumes DIR --out DIR --seeds 0:120 [--each 2]

The plumes must be none that the prior's other networks were taught on: it trusts them as far as they are right here.
"""

from __future__ import annotations

from backend import kernel_setup  # noqa: F401 before numba loads

# isort: split
import sys
from functools import cache, partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from backend.contract.cameras import Cameras
from backend.field.rays import optical_depth
from backend.fit.region import FINER, PIXELS_A_CELL
from backend.fit.weighed import Weighing
from backend.geometry.camera import View
from backend.io.atomic import whole_file
from backend.prior.predict import Prior
from backend.prior.shares import NAMES, ShareNet
from backend.prior.window import Stand
from backend.reporting import SilentReport
from backend.stages import volume
from training.judge import layer_of
from training.lessons import draw_some, write_all
from training.library import FPS, NUM_FRAMES, VELOCITY_EVERY, Plume, read_plume
from training.samples import LEAST_WHOLE, MOST, camera_way, cell_for, filmed, lattice_of, smoke_of, truth

_SHORTEST = 45  # frames of a clip
_MOMENTS = 8  # of it that are learned from
_SIDES_FINER = 1.05  # than the finest pictures that a fit compares with: it makes them smaller
_LEAST = 0.05  # 1/m, of the densest smoke: a moment with less teaches nothing


def draw_clip(plume: Plume, draw: np.random.Generator, *, prior: Prior) -> dict[str, np.ndarray] | None:
    """What a fit knows of some moments of a random part of the plume's time; None where hardly any smoke is."""
    num_frames = int(draw.integers(_SHORTEST, NUM_FRAMES + 1))
    first = int(draw.integers(0, NUM_FRAMES - num_frames + 1))
    layers, cameras = _filmed(plume, draw, first, num_frames)
    report = SilentReport()
    plan = volume.make_plan(layers, cameras, every=5)
    if plan is None:
        return None
    plan = volume.centred(plan, report, prior=prior)
    proposals = list(volume.propose(plan, report, prior=prior, done=[]))
    levels = volume.levels_of(plan, proposals, prior.levels)
    if levels is None:
        raise ValueError("a prior without a network of levels has nothing to weigh")
    weighing = Weighing(region=plan.region, levels=levels, net=ShareNet())
    edges = np.linspace(0, num_frames, _MOMENTS + 1).astype(int)
    drawn = [int(draw.integers(low, high)) for low, high in pairwise(edges)]
    moments = [max(moment - (first + moment) % VELOCITY_EVERY, 0) for moment in drawn]  # whose velocities a library holds, too
    rows = []
    for word in volume.words(plan, proposals, levels, moments):
        stand = word.said.stand
        real, _ = truth(plume, first + word.frame, Stand(lattice=stand.lattice, from_world=stand.from_world @ plan.straight))
        if real.max() < _LEAST:
            continue
        known = weighing.known(word.said, word.sharp, word.lasts, word.frame)
        picture, view = plan.region.finer.of(word.frame)
        rows.append(
            {name: getattr(known, name).astype(np.float16) for name in NAMES}
            | {"picture": picture.astype(np.float16), "camera": camera_of(stand.seen(view))}
            | {"voxel_size": np.array(stand.lattice.voxel_size), "truth": real.astype(np.float16)}
        )
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]} if rows else None


def _filmed(plume: Plume, draw: np.random.Generator, first: int, num_frames: int) -> tuple[list[np.ndarray], Cameras]:
    """Smoke layers [H, W, 4] of evenly lit smoke that the pictures hold, and the cameras."""
    kind = draw.choice(["orbit", "wild"], p=[0.8, 0.2])
    smoke = smoke_of(plume, first, num_frames)
    cell, finer = cell_for(smoke, draw, is_whole=True), FINER * _SIDES_FINER
    size = np.rint(finer * draw.integers(LEAST_WHOLE, MOST, endpoint=True)).astype(int)
    height, pixel = 0.5 * (smoke.bottom + smoke.top) + draw.normal(0.0, cell), cell / (finer * PIXELS_A_CELL)
    views = camera_way(draw, kind, num_frames, height=height, pixel=pixel, size=size)
    lattice, noise, layers = lattice_of(plume), draw.choice([0.002, 0.01]), []
    for index, view in enumerate(views):
        depth = optical_depth(plume.density_at(first + index), lattice, view, step=0.75)
        layers.append(layer_of(-np.expm1(-filmed(depth, noise, draw))))
    return layers, _cameras_of(views)


def _cameras_of(views: list[View]) -> Cameras:
    view = views[0]
    places = tuple(tuple(tuple(map(float, row)) for row in each.camera_to_world) for each in views)
    return Cameras(
        width=view.width, height=view.height, fx=view.fx, fy=view.fy, cx=view.cx, cy=view.cy, fps=FPS, camera_to_world=places
    )


def camera_of(view: View) -> np.ndarray:
    """[20]: its matrix row by row, then fx, fy, cx, cy."""
    return np.concatenate([np.asarray(view.camera_to_world, np.float64).ravel(), [view.fx, view.fy, view.cx, view.cy]])


def write_lessons(plume: Path, target: Path, *, seed: int, count: int) -> None:
    """Draw the moments of `count` clips of one plume, a file for each, or leave those that are there."""
    done = target.with_name(f"{target.stem}.done")
    if done.exists():
        return
    drawn = draw_some(partial(draw_clip, prior=_prior()), read_plume(plume), seed=seed, count=count)
    for number, clip in enumerate(drawn):
        with whole_file(target.with_name(f"{target.stem}_{number}.npz")) as part, open(part, "wb") as file:
            np.savez(file, **clip)  # type: ignore[arg-type]
    done.touch()


@cache
def _prior() -> Prior:
    return Prior()


if __name__ == "__main__":
    sys.exit(write_all(sys.argv[1:], write_lessons, description=__doc__, each=2))
