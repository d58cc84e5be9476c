"""A benchmark scene of a few frames, drawn from particles that are known: four views, a future, volumes."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.truth import SMOKE_VIDEO, TRUTH_FILE, TRUTH_FOLDER, VOLUMES_FILE, view_folder
from backend.geometry.camera import view_at
from backend.geometry.lattice import Lattice
from backend.io.images import linear_to_srgb
from backend.io.particles import ParticleFrame
from backend.render.picture import picture
from backend.render.voxelize import voxelize
from synthetic.shipped import encode_smoke

NUM_FRAMES, NUM_SEEN, FPS = 8, 6, 10.0
VIEWS = {"input": list(range(NUM_FRAMES)), "nvs": [0, 2, 4, 6], "side": [0, 4], "back": [0, 4]}
VOLUME_FRAMES = (0, 2, 4)
LATTICE = Lattice(origin=(-1.5, -1.5, 0.0), voxel_size=0.25, shape=(13, 13, 17))


def draw_scene(folder: Path, *, wind: float) -> Path:
    """A helix of puffs that rises at 1 m/s and goes with the wind, m/s along x."""
    for view, frames in VIEWS.items():
        place = folder / view_folder(view)
        place.mkdir(parents=True, exist_ok=True)
        seen_from = cameras(view)
        (place / "cameras.json").write_text(seen_from.to_json())
        shown = [drawn(puffs(frame, wind), seen_from, frame) for frame in frames]
        num_seen = NUM_SEEN if view == "input" else len(shown)
        encode_smoke(iter(shown[:num_seen]), place / SMOKE_VIDEO, fps=FPS)
        if view == "input":
            (folder / TRUTH_FOLDER).mkdir(exist_ok=True)
            encode_smoke(iter(shown[num_seen:]), folder / TRUTH_FOLDER / "future.mkv", fps=FPS)
    grids = [voxelize(puffs(frame, wind), LATTICE) for frame in VOLUME_FRAMES]
    with h5py.File(folder / TRUTH_FOLDER / VOLUMES_FILE, "w") as file:
        file.attrs["voxel_size"], file.attrs["origin"] = LATTICE.voxel_size, LATTICE.origin
        for name in ("density", "velocity"):
            file[name] = np.stack([grid[name] for grid in grids])
            file[f"{name}_frames"] = np.array(VOLUME_FRAMES)
    counts = {"count": NUM_FRAMES, "seen": NUM_SEEN, "fps": FPS}
    truth = {"scene": folder.name, "frames": counts, "views": VIEWS}
    (folder / TRUTH_FOLDER / TRUTH_FILE).write_text(json.dumps(truth))
    return folder


def puffs(frame: int, wind: float, count: int = 40) -> ParticleFrame:
    age = np.linspace(0.0, 1.5, count) + frame / FPS
    turn = 5.0 * np.linspace(0.0, 1.5, count)
    positions = np.stack([0.25 * np.cos(turn) + wind * age, 0.25 * np.sin(turn), 0.5 + age], axis=1)
    return ParticleFrame(
        positions=positions,
        velocities=np.tile(np.array([wind, 0.0, 1.0], np.float32), (count, 1)),
        scales=np.full(count, 0.16, np.float32),
        optical_masses=np.full(count, 0.12, np.float32),
        colors=np.full((count, 3), 0.6, np.float32),
        ids=np.arange(count),
    )


def drawn(frame: ParticleFrame, seen_from: Cameras, number: int) -> np.ndarray:
    """[H, W, 4] uint8 BGRA, as a packed scene keeps it."""
    found = picture(frame, view_at(seen_from, 0 if seen_from.is_still else number))
    coded = np.concatenate([linear_to_srgb(found[..., 2::-1]), found[..., 3:]], axis=2)
    return np.rint(255.0 * np.clip(coded, 0.0, 1.0)).astype(np.uint8)


def cameras(view: str) -> Cameras:
    """The input camera turns by 5 degrees a frame."""
    azimuths = {"input": [-105.0 + 5.0 * frame for frame in range(NUM_FRAMES)], "nvs": [-105.0], "side": [-15.0], "back": [75.0]}
    matrices = tuple(towards_axis(azimuth) for azimuth in azimuths[view])
    return Cameras(width=48, height=64, fx=80.0, fy=80.0, cx=24.0, cy=32.0, fps=FPS, camera_to_world=matrices)


def towards_axis(azimuth: float) -> tuple[tuple[float, ...], ...]:
    """Level, 5 m from the z axis, 1.6 m above the ground."""
    c, s = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    matrix = np.eye(4)
    forward, down = np.array([-c, -s, 0.0]), np.array([0.0, 0.0, -1.0])
    matrix[:3, :3] = np.stack([np.cross(down, forward), down, forward], axis=1)
    matrix[:3, 3] = 5.0 * c, 5.0 * s, 1.6
    return tuple(map(tuple, matrix.tolist()))
