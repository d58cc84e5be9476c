"""What volumes lose by where their levels lie in depth: those of finished jobs, with levels moved to where they truly lie.

    python -m benchmarks.depth_levels --jobs DIR [--from SET] [--scenes A,B] [--json FILE]

DIR holds a finished job for each scene, as benchmarks.reconstruction leaves them in OUT/PRESET/METHOD. The truth moves the
levels, so no figure of this is a score: it tells which error is worth mending. Ways, of which each contains the one before it:

as it is          the volume on a grid before its camera, as all others are
still             each level moved along the view by one length for the whole clip
at each moment    by a length for each moment
and as deep       made as deep as it is, too (standard deviation)

Pictures are of evenly lit smoke, sRGB on black, at half the benchmark's size; the first place in the last third of the clip.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import ndimage

from backend.contract.truth import INPUT_VIEW
from backend.field.rays import optical_depth
from backend.geometry.camera import View, resized
from backend.geometry.lattice import Lattice
from backend.io.atomic import write_text
from backend.io.job_folder import JobFolder
from backend.prior.window import Stand, stand_before
from backend.score.exported import Exported
from backend.score.measures import coded, correlation, decibels
from backend.score.truth_set import Truth, read_truth_set
from benchmarks.finished_jobs import read_options
from synthetic.progress import Progress

WAYS = ("as it is", "still", "at each moment", "and as deep")
FIGURES = ("density", "nvs_last_db", "side_db")
_FIRST, _EVERY = 30, 2  # of the frames with volumes: by then there is smoke to be wrong about
_FAINT = 1e-3  # of the fullest level: one with less is left where it is
_LEAST_DEPTH = 0.3  # voxels, standard deviation: what is thinner is not made thinner
_LIGHT = 0.4  # of opaque smoke, linear
_VOXEL = 0.25  # m
_SIZE = 64, 64, 84  # voxels


def main(arguments: Sequence[str] | None = None) -> int:
    given = read_options(arguments, description=__doc__, scenes="puff_front,merging_sources,steady_plume")
    weights = given.weights()
    found = {job.name: scene_figures(job, read_truth_set(given.source / job.name)) for job in given.jobs}
    scenes = list(found)
    found["mean"] = {
        way: {name: round(float(np.mean([found[scene][way][name] for scene in scenes])), 3) for name in FIGURES} for way in WAYS
    }
    print(f"{'scene':<18} {'levels':<16} " + " ".join(f"{name:>11}" for name in FIGURES))
    for scene, ways in found.items():
        for way, figures in ways.items():
            print(f"{scene:<18} {way:<16} " + " ".join(f"{figures[name]:>11.3f}" for name in FIGURES))
    if given.json is not None:
        write_text(given.json, json.dumps({"weights": weights, "scenes": found}, indent=1, allow_nan=False) + "\n")
    return 0


def scene_figures(job: Path, truth: Truth) -> dict[str, dict[str, float]]:
    """Means over moments of each way's figures."""
    exported = Exported(JobFolder(job).vdb, frame_start=truth.frames[INPUT_VIEW][0])
    frames = [frame for frame in truth.volume_frames() if _FIRST <= frame < truth.num_seen][::_EVERY]
    pairs = {frame: _pair(exported, truth, frame) for frame in frames}
    shapes = {frame: (Level.of(ours), Level.of(real)) for frame, (_, ours, real) in pairs.items()}
    weight = sum(np.where(_both(*shapes[frame]), shapes[frame][0].mass, 0.0) for frame in frames)
    wrong = sum(
        np.where(_both(ours, real), ours.mass * (real.middle - ours.middle), 0.0) for ours, real in shapes.values()
    ) / np.maximum(weight, 1e-9)
    rows: dict[str, list[dict[str, float]]] = {way: [] for way in WAYS}
    progress = Progress(label=f"move levels of {job.name}", total=len(frames))
    for frame, (stand, ours, real) in pairs.items():
        own, true = shapes[frame]
        both = _both(own, true)
        shift, scale = np.where(both, true.middle - own.middle, 0.0), np.where(both, true.depth / own.depth, 1.0)
        changes = {
            "as it is": (0 * shift, 1.0),
            "still": (wrong, 1.0),
            "at each moment": (shift, 1.0),
            "and as deep": (shift, scale),
        }
        for way, (by, wider) in changes.items():
            moved = moved_levels(ours, own.middle, by, wider)
            rows[way].append({"density": correlation(moved, real)} | _views(moved, real, stand, truth, frame))
        progress.step()
    return {
        way: {name: round(float(np.mean([row[name] for row in of if name in row])), 3) for name in FIGURES}
        for way, of in rows.items()
    }


class Level:
    """Of each level of a density [X, Y, Z]: mass, middle and standard deviation along y, voxels; [Z] each."""

    def __init__(self, mass: np.ndarray, middle: np.ndarray, depth: np.ndarray) -> None:
        self.mass, self.middle, self.depth = mass, middle, depth

    @classmethod
    def of(cls, density: np.ndarray) -> Level:
        in_depth, y = density.sum(axis=0, dtype=np.float64), np.arange(density.shape[1])
        mass = in_depth.sum(axis=0)
        middle = y @ in_depth / np.maximum(mass, 1e-12)
        spread = (np.square(y[:, None] - middle) * in_depth).sum(axis=0) / np.maximum(mass, 1e-12)
        return cls(mass, middle, np.sqrt(np.maximum(spread, _LEAST_DEPTH**2)))


def moved_levels(density: np.ndarray, middle: np.ndarray, by: np.ndarray, wider: np.ndarray | float) -> np.ndarray:
    """Density [X, Y, Z] with each level moved along y `by` [Z] voxels, and made `wider` [Z] times as deep around its `middle`."""
    x, y, z = np.indices(density.shape, dtype=np.float64)
    places = (y - middle - by) / wider + middle
    return ndimage.map_coordinates(density, np.stack([x, places, z]), order=1, mode="constant") / np.float32(wider)


def _both(ours: Level, real: Level) -> np.ndarray:
    """[Z]: levels with enough smoke in both to have a middle."""
    return (ours.mass > _FAINT * ours.mass.max()) & (real.mass > _FAINT * real.mass.max())


def _pair(exported: Exported, truth: Truth, frame: int) -> tuple[Stand, np.ndarray, np.ndarray]:
    """A grid before the camera, and on it our density and the true one, 1/m."""
    volume = truth.volume(frame)
    lattice: Lattice = volume.lattice
    low, high = (np.array([axis[index] for axis in lattice.axes()]) for index in (0, -1))
    stand = stand_before(truth.view(INPUT_VIEW, frame), 0.5 * (low + high), voxel_size=_VOXEL, shape=_SIZE)
    at = np.moveaxis((stand.centres() - low) / lattice.voxel_size, -1, 0)
    ours, real = (
        ndimage.map_coordinates(np.asarray(density, np.float32), at, order=1, mode="constant")
        for density in (exported.density_at(lattice, frame), volume.density)
    )
    return stand, ours, real


def _views(ours: np.ndarray, real: np.ndarray, stand: Stand, truth: Truth, frame: int) -> dict[str, float]:
    views = {"side_db": "side"} | ({"nvs_last_db": "nvs"} if frame >= 2 * truth.num_seen // 3 else {})
    found = {}
    for name, place in views.items():
        view = truth.view(place, frame)
        seen = stand.seen(resized(view, (view.width // 2, view.height // 2)))
        wrong = _picture(ours, stand, seen) - _picture(real, stand, seen)
        found[name] = decibels(float(np.square(wrong).mean(dtype=np.float64)))
    return found


def _picture(density: np.ndarray, stand: Stand, view: View) -> np.ndarray:
    opacity = -np.expm1(-optical_depth(density, stand.lattice, view))
    return coded(np.dstack([_LIGHT * opacity] * 3 + [opacity]).astype(np.float32))


if __name__ == "__main__":
    sys.exit(main())
