"""How fast this machine is: seconds of a standard piece of each kind of work, by the real kernels, kept in the cache folder.

A piece is timed several times and the fastest counts: what else the machine was doing is not the machine's. The file
machine.json says for which version, processor and number of threads it holds; for any other it is measured anew.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np

from backend import __version__
from backend.fit.image_motion import dense_flow
from backend.geometry.camera import View, resized
from backend.geometry.lattice import Lattice
from backend.io.atomic import write_text
from backend.io.particles import ParticleFrame
from backend.kernel_setup import caches_home, sources_fingerprint
from backend.render import splat as renderer
from backend.render.gaussians import isotropic
from backend.render.voxelize import voxelize
from backend.stopwatch import Stopwatch

MACHINE_FILE = "machine.json"
NUM_PARTICLES = 4000  # of a standard piece
WIDTH, HEIGHT = 144, 256  # px
_LEAST_REPEATS, _MOST_REPEATS, _ENOUGH_SECONDS = 3, 12, 0.4


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """seconds: of a standard piece, by kind. threads: that the kernels use."""

    seconds: dict[str, float]
    threads: int


def this_machine(kinds: Collection[str], *, folder: Path | None = None) -> Machine:
    """The pieces of these kinds, from the file in the cache folder where they are there, else measured now and kept."""
    path = (caches_home() if folder is None else folder) / MACHINE_FILE
    key = machine_key()
    kept = _kept(path, key)
    missing = [kind for kind in kinds if kind not in kept]
    if missing:
        kept |= {kind: fastest(PIECES[kind]()) for kind in missing}
        with contextlib.suppress(OSError):  # a cache that cannot be kept is measured again the next time
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, json.dumps({"machine": key, "seconds": kept}, indent=2))
    return Machine(seconds={kind: kept[kind] for kind in kinds}, threads=int(key["threads"]))


def machine_key() -> dict[str, Any]:
    """For what the measured seconds hold."""
    return {
        "version": __version__,
        "kernels": sources_fingerprint(),
        "pieces": hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16],
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": numba.get_num_threads(),
    }


def _kept(path: Path, key: dict[str, Any]) -> dict[str, float]:
    """What the file holds for this machine; nothing where there is none, or it is damaged or another's."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["machine"] != key:
            return {}
        kept = {str(kind): float(seconds) for kind, seconds in data["seconds"].items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return {}
    return {kind: seconds for kind, seconds in kept.items() if kind in PIECES and 0.0 < seconds < 1e3}


def fastest(piece: Callable[[], object]) -> float:
    """Seconds of the fastest of several runs, after one that is not counted: it compiles and warms."""
    piece()
    times: list[float] = []
    while len(times) < _LEAST_REPEATS or (len(times) < _MOST_REPEATS and sum(times) < _ENOUGH_SECONDS):
        watch = Stopwatch()
        piece()
        times.append(watch.seconds())
    return max(min(times), 1e-6)


def _plume() -> tuple[np.ndarray, np.ndarray]:
    """Positions [N, 3] m of a column two metres high, and optical masses [N] m^2."""
    random = np.random.default_rng(0)
    height = 2.0 * random.random(NUM_PARTICLES)
    radius = (0.15 + 0.2 * height)[:, None]
    positions = np.concatenate([radius * random.normal(size=(NUM_PARTICLES, 2)), height[:, None]], axis=1)
    return positions, np.full(NUM_PARTICLES, 1.5 / NUM_PARTICLES)


def _view() -> View:
    """Five metres before the column, level."""
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    camera_to_world[:3, 3] = (0.0, -5.0, 1.0)
    return View(width=WIDTH, height=HEIGHT, fx=450.0, fy=450.0, cx=WIDTH / 2, cy=HEIGHT / 2, camera_to_world=camera_to_world)


def _splat() -> Callable[[], object]:
    """One drawing of the particles with three features, and its gradient."""
    positions, masses = _plume()
    gaussians, view = isotropic(positions, np.full(NUM_PARTICLES, 0.04), masses), _view()
    features = np.full((NUM_PARTICLES, 3), 0.5, np.float32)

    def piece() -> object:
        drawn = renderer.forward(gaussians, view, features=features)
        return renderer.backward(drawn, drawn.image)

    return piece


def _pixels() -> Callable[[], object]:
    """What is done to whole pictures: dense motion, blur, powers."""
    layer = np.random.default_rng(0).random((HEIGHT, WIDTH, 4), np.float32)
    layer = cv2.GaussianBlur(layer, (0, 0), 4.0)
    later = np.roll(layer, 2, axis=0)
    return lambda: (dense_flow(layer, later), np.log1p(layer), layer**0.4)


def _voxels() -> Callable[[], object]:
    """The particles on a grid of 48 x 48 x 96 voxels, with their velocity."""
    positions, masses = _plume()
    count = len(positions)
    frame = ParticleFrame(
        positions=positions,
        velocities=np.ones((count, 3), np.float32),
        scales=np.full(count, 0.04, np.float32),
        optical_masses=masses.astype(np.float32),
        colors=np.ones((count, 3), np.float32),
        ids=np.arange(count),
    )
    lattice = Lattice(origin=(-1.2, -1.2, 0.0), voxel_size=0.05, shape=(48, 48, 48))
    return lambda: voxelize(frame, lattice)


def _network() -> Callable[[], object]:
    """One proposal of the prior, in one thread."""
    from backend.prior.predict import Prior  # torch: two seconds that clips without need of it do not wait

    prior, view = Prior(), _view()
    small = resized(view, (WIDTH // 4, HEIGHT // 4))
    across = np.exp(-np.square(np.linspace(-3.0, 3.0, small.width))).astype(np.float32)
    depth = np.tile(across, (small.height, 1))
    return lambda: prior.propose(
        lambda _: depth,
        lambda _: small,
        np.array([0.0, 0.0, 1.0]),
        np.zeros(3),
        8,
        voxel_size=0.06,
        stride=1,
        num_frames=16,
        seconds_per_frame=1.0 / 15.0,
    )


PIECES: dict[str, Callable[[], Callable[[], object]]] = {
    "splat": _splat,
    "pixels": _pixels,
    "voxels": _voxels,
    "network": _network,
}
