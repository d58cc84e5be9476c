"""Lessons for the network of levels: clips of a library's plumes as a moving camera films them, and where levels truly lie.

DIR/0001.npz   profile and mass [N, T, Z, X] uint8: 255 sqrt of a share; turns [N, 3, T], clues [N, C, T, Z], middle
               [N, T, Z, X] and the logarithm of width [N, T, Z], in units behind the source; float16

.venv/backend/bin/python -m training.level_lessons --plumes DIR --out DIR --seeds 0:120 [--each 100]
"""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path

import numpy as np

from backend.field.rays import optical_depth
from backend.fit.region import CELLS_HIGH, PIXELS_A_CELL
from backend.fit.source import source_point
from backend.io.atomic import whole_file
from backend.prior.sheets import NUM_PARTS, PART, UNIT, look_at_sheets, moments_around
from backend.prior.window import away_of
from training.lessons import draw_some, write_all
from training.library import NUM_FRAMES, Plume, read_plume
from training.samples import (
    FOOT_FRAMES,
    LEAST,
    LEAST_WHOLE,
    MOST,
    camera_way,
    cell_for,
    filmed,
    lattice_of,
    smoke_of,
    stride_for,
)

_SHORTEST = 30, 90  # frames of a clip, as often as the other
_WHOLE = 0.75  # of the lessons: their pictures show all of the smoke
_ROOMY = 0.4  # of the lessons: there is room around what is pictured
_COARSE = 2  # times as large pixels as a fit's: parts are larger yet
_FAINT = 20.0  # 1/m, summed over the voxels of four moments: less shows no smoke


def draw_clip(plume: Plume, draw: np.random.Generator) -> dict[str, np.ndarray] | None:
    """A random part of the plume's time, camera and noise; None where hardly any smoke is."""
    num_frames = int(draw.integers(draw.choice(_SHORTEST), NUM_FRAMES + 1))
    first = int(draw.integers(0, NUM_FRAMES - num_frames + 1))
    kind = draw.choice(["orbit", "wild"], p=[0.8, 0.2])
    smoke = smoke_of(plume, first, num_frames)
    is_whole = draw.random() < _WHOLE
    cell = cell_for(smoke, draw, is_whole=is_whole)
    cut = max(smoke.top - smoke.bottom - CELLS_HIGH * cell, 0.0)
    height = 0.5 * (smoke.bottom + smoke.top) - draw.uniform(0.0, 0.6) * cut + draw.normal(0.0, cell)
    size = draw.integers(LEAST_WHOLE if is_whole else LEAST, MOST, endpoint=True)
    if draw.random() < _ROOMY:
        size = (size * draw.uniform(1.0, 2.0, 2)).astype(int)
    stride = stride_for(smoke, draw, cell=cell, num_frames=num_frames)
    views = camera_way(draw, kind, num_frames, height=height, pixel=_COARSE * cell / PIXELS_A_CELL, size=size // _COARSE)
    lattice, noise = lattice_of(plume), draw.choice([0.002, 0.01])

    @cache
    def clear_depth_at(index: int) -> np.ndarray:
        return optical_depth(plume.density_at(first + index), lattice, views[index], step=1.0)

    def depth_at(index: int) -> np.ndarray:
        return filmed(clear_depth_at(index), noise, np.random.default_rng(index))

    frames = moments_around(int(draw.integers(0, num_frames)), stride=stride, num_frames=num_frames)
    seen = np.unique(frames)
    if sum(plume.density_at(first + int(frame)).sum(dtype=np.float64) for frame in seen[:: len(seen) // 4]) < _FAINT:
        return None
    foot = [int(frame) for frame in seen[:: max(1, len(seen) // FOOT_FRAMES)]]
    source = source_point(lambda index: clear_depth_at(foot[index]), [views[frame] for frame in foot], most_frames=len(foot))
    source = source + draw.normal(0.0, 0.15, 3)
    sheets = look_at_sheets(depth_at, lambda index: views[index], source, frames, height=height, voxel_size=cell, stride=stride)
    levels = lattice.origin[2] + plume.voxel_size * np.arange(lattice.shape[2])
    at_height = _between(sheets.heights, levels)
    places = np.stack(np.meshgrid(*lattice.axes()[:2], indexing="ij"), axis=-1).reshape(-1, 2) - source[:2]

    @cache
    def true_at(frame: int) -> tuple[np.ndarray, ...]:
        """Mass and middle [Z, X] of the parts of each level, and the spread [Z] of a part, in units."""
        density = plume.density_at(first + frame).reshape(-1, lattice.shape[2]) @ at_height
        away = away_of(views[frame])[:2]
        part = (places @ np.array([away[1], -away[0]])) / (PART * cell) + 0.5 * (NUM_PARTS - 1)
        share = _between(part, np.arange(NUM_PARTS))  # [X, places]
        deep = (places @ away / (UNIT * cell)).astype(np.float32)[:, None]
        mass, mean, square = (share @ (density * weight) for weight in (1.0, deep, deep * deep))
        safe = np.maximum(mass, 1e-6)
        spread = (square - mean * mean / safe).sum(axis=0) / np.maximum(mass.sum(axis=0), 1e-6)
        return mass.T, (mean / safe).T, np.sqrt(np.maximum(spread, 1e-3))

    mass, middle, width = (np.stack(part) for part in zip(*(true_at(int(frame)) for frame in frames), strict=True))
    if not mass.any():
        return None
    return {
        "profile": coded(sheets.profile),
        "turns": sheets.turns.astype(np.float16),
        "clues": sheets.clues.astype(np.float16),
        "mass": coded(mass / max(float(mass.sum(axis=-1).max()), 1e-6)),
        "middle": middle.astype(np.float16),
        "width": np.log(width).astype(np.float16),
    }


def coded(values: np.ndarray) -> np.ndarray:
    """0 to 1 -> uint8, finer where there is little."""
    return np.rint(255 * np.sqrt(np.clip(values, 0.0, 1.0))).astype(np.uint8)


def _between(at: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """[K, N] float32: linear weights of evenly spaced knots [K] at places [N]; nothing beyond the outermost by one step."""
    place = (at - knots[0]) / (knots[1] - knots[0])
    return np.maximum(0.0, 1.0 - np.abs(np.arange(len(knots))[:, None] - place)).astype(np.float32)


def write_lessons(plume: Path, target: Path, *, seed: int, count: int) -> None:
    """Draw `count` clips of one plume, or leave the file that is there."""
    if target.exists():
        return
    drawn = draw_some(draw_clip, read_plume(plume), seed=seed, count=count)
    arrays = {name: np.stack([clip[name] for clip in drawn]) for name in drawn[0]}
    with whole_file(target) as part, open(part, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    sys.exit(write_all(sys.argv[1:], write_lessons, description=__doc__, each=100))
