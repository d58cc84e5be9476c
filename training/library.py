"""The plumes on disk: each simulated once, as small arrays that a training can map into memory.

DIR/0001/density.npy   [F, X, Y, Z] uint8: 255 sqrt(density / MOST_DENSITY), every frame
DIR/0001/velocity.npy  [F / VELOCITY_EVERY, X, Y, Z, 3] float16 m/s, every VELOCITY_EVERY frames
DIR/0001/plume.json    where the voxels lie; written last

.venv/backend/bin/python -m training.library --out DIR --seeds 0:150 [--voxel-size 0.5]
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from backend.io.atomic import whole_file
from synthetic.progress import Progress
from synthetic.scenes import SmokeScene
from synthetic.solver.fields import centred_velocity
from synthetic.solver.simulation import prepare, run
from training.plumes import plume

VOXEL_SIZE = 1 / 3  # m
FPS = 15.0
NUM_FRAMES = 135
VELOCITY_EVERY = 3  # frames
MOST_DENSITY = 9.0  # 1/m; more is cut off


@dataclass(frozen=True, slots=True, kw_only=True)
class Plume:
    """One simulated plume, mapped into memory. origin: centre of the first voxel, m; voxel_size m."""

    scene: SmokeScene
    density: np.ndarray
    velocity: np.ndarray
    origin: tuple[float, float, float]
    voxel_size: float = VOXEL_SIZE

    def density_at(self, frame: int) -> np.ndarray:
        """[X, Y, Z] float32 1/m."""
        coded = np.asarray(self.density[frame], np.float32) / 255
        return MOST_DENSITY * coded * coded

    def velocity_at(self, frame: int) -> np.ndarray:
        """[X, Y, Z, 3] float32 m/s; frame: a multiple of VELOCITY_EVERY."""
        return np.asarray(self.velocity[frame // VELOCITY_EVERY], np.float32)


def simulate(seed: int, folder: Path, *, voxel_size: float) -> None:
    """Write a plume, or leave the one that is there."""
    if (folder / "plume.json").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    simulation = prepare(plume(seed), voxel_size=voxel_size, time_step=1 / FPS)
    densities, velocities = [], []
    for frame, state in enumerate(run(simulation, num_frames=NUM_FRAMES, fps=FPS)):
        densities.append(coded(state.density))
        if frame % VELOCITY_EVERY == 0:
            velocities.append(centred_velocity(state).astype(np.float16))
    for name, stack in (("density", densities), ("velocity", velocities)):
        with whole_file(folder / f"{name}.npy") as part, open(part, "wb") as file:
            np.save(file, np.stack(stack))
    with whole_file(folder / "plume.json") as part:
        told = {"seed": seed, "origin": simulation.grid.first_centre, "voxel_size": voxel_size}
        part.write_text(json.dumps(told), encoding="utf-8")


def coded(density: np.ndarray) -> np.ndarray:
    """1/m -> uint8, finer where there is little."""
    return np.rint(255 * np.sqrt(np.clip(density / MOST_DENSITY, 0, 1))).astype(np.uint8)


def read_plume(folder: Path) -> Plume:
    told = json.loads((folder / "plume.json").read_text(encoding="utf-8"))
    arrays = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in ("density", "velocity")}
    size = told.get("voxel_size", VOXEL_SIZE)
    return Plume(scene=plume(told["seed"]), origin=tuple(told["origin"]), voxel_size=size, **arrays)


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", default="0:150", help="A:B")
    parser.add_argument("--voxel-size", type=float, default=VOXEL_SIZE, help="m")
    given = parser.parse_args(arguments)
    first, stop = map(int, given.seeds.split(":"))
    progress = Progress(label="simulate plumes", total=stop - first)
    for seed in range(first, stop):
        simulate(seed, given.out / f"{seed:04d}", voxel_size=given.voxel_size)
        progress.step()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
