"""Runs a scene and writes what happens: one VDB a frame, resumable, the same bytes however often it was interrupted.

A folder of smoke holds smoke_0001.vdb .. (grids `density` 1/m, `temperature` K excess, and every few frames `velocity`
m/s), smoke.json (settings, written before the first frame), state.npz (the newest state, from which a broken run goes on).
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from backend.contract.errors import BackendError
from backend.contract.result import vdb_path
from backend.io.atomic import whole_file
from backend.io.vdb import write_vdb
from synthetic.scenes import SmokeScene
from synthetic.solver.fields import Grid, SmokeState, centred_velocity
from synthetic.solver.simulation import Simulation, advance, begin, prepare

SMOKE_FILE = "smoke.json"
STATE_FILE = "state.npz"
_FORMAT_VERSION = 1
_CHECKPOINT_SECONDS = 20.0
_FAINT = 1e-4  # 1/m and K: less than this is not written


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """How a scene is simulated and kept. steps_per_frame steps of 1 / (fps steps_per_frame) s; velocity_every frames."""

    scene: SmokeScene
    num_frames: int
    fps: float
    voxel_size: float
    steps_per_frame: int = 2
    velocity_every: int = 5

    def simulation(self) -> Simulation:
        return prepare(self.scene, voxel_size=self.voxel_size, time_step=1 / (self.fps * self.steps_per_frame))

    def to_data(self) -> dict[str, object]:
        """Everything that decides the bytes of the frames, for smoke.json."""
        data = json.loads(json.dumps(dataclasses.asdict(self), default=str).replace("Infinity", "null"))
        units = {"density": "1/m", "temperature": "K above the air around", "velocity": "m/s", "lengths": "m"}
        return {"format_version": _FORMAT_VERSION, "units": units, **data}


def record(recording: Recording, folder: Path, *, progress: Callable[[], None]) -> None:
    """Write all frames that are missing; calls progress() once for each frame. Raises BackendError on another run's folder."""
    folder.mkdir(parents=True, exist_ok=True)
    _claim(recording, folder)
    simulation = recording.simulation()
    if all(vdb_path(folder, frame).exists() for frame in range(recording.num_frames)):
        for _ in range(recording.num_frames):
            progress()
        return
    frame, state = _resume(simulation, folder)
    for _ in range(frame):
        progress()
    kept = time.monotonic()
    while True:
        path = vdb_path(folder, frame)
        if not path.exists():
            write_frame(path, state, simulation.grid, has_velocity=frame % recording.velocity_every == 0)
        progress()
        if frame + 1 >= recording.num_frames:
            return
        if time.monotonic() - kept > _CHECKPOINT_SECONDS:
            _keep(folder, frame, state)
            kept = time.monotonic()
        for _ in range(recording.steps_per_frame):
            state = advance(simulation, state)
        frame += 1


def write_frame(path: Path, state: SmokeState, grid: Grid, *, has_velocity: bool) -> None:
    """One moment as VDB, cropped to the smoke; velocity over the whole box, for smoke moves where there was none."""
    low, high = _bounds(state)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    h = grid.voxel_size
    grids = {name: _without_faint(getattr(state, name)[box]) for name in ("density", "temperature")}
    origin = tuple(start + h * index for start, index in zip(grid.first_centre, low, strict=True))
    if has_velocity:
        grids = {name: np.zeros(grid.shape, np.float32) for name in grids}
        for name, array in grids.items():
            array[box] = _without_faint(getattr(state, name)[box])
        grids["velocity"] = centred_velocity(state)
        origin = grid.first_centre
    write_vdb(path, grids, voxel_size=h, origin=origin)  # type: ignore[arg-type]


def _without_faint(values: np.ndarray) -> np.ndarray:
    return np.where(values > _FAINT, values, np.float32(0))


def _bounds(state: SmokeState) -> tuple[list[int], list[int]]:
    """First and one-past-last cell along each axis that holds smoke or heat; one cell where there is none."""
    is_used = (state.density > _FAINT) | (state.temperature > _FAINT)
    low, high = [], []
    for axis in range(3):
        others = tuple(other for other in range(3) if other != axis)
        used = np.flatnonzero(is_used.any(axis=others))
        low.append(int(used[0]) if used.size else 0)
        high.append(int(used[-1]) + 1 if used.size else 1)
    return low, high


def _claim(recording: Recording, folder: Path) -> None:
    """Write smoke.json, or check that the one there is of the same run."""
    path = folder / SMOKE_FILE
    data = recording.to_data()
    if path.exists():
        if json.loads(path.read_text(encoding="utf-8")) != data:
            raise BackendError(
                "other_simulation", f"{folder} holds another simulation.", hint="Choose another folder, or remove that one."
            )
        return
    with whole_file(path) as part:
        part.write_text(json.dumps(data, indent=2, sort_keys=True), encoding="utf-8")


def _keep(folder: Path, frame: int, state: SmokeState) -> None:
    with whole_file(folder / STATE_FILE) as part, open(part, "wb") as file:
        np.savez(file, frame=frame, **dataclasses.asdict(state))


def _resume(simulation: Simulation, folder: Path) -> tuple[int, SmokeState]:
    """The newest kept state and its frame; else the state of frame 0."""
    path = folder / STATE_FILE
    if path.exists():
        with np.load(path) as data:
            values = {name: data[name] for name in data.files}
        frame = int(values.pop("frame"))
        numbers = {name: float(values.pop(name)) for name in ("time", "emitted", "left")}
        return frame, SmokeState(**numbers, **values)
    state = begin(simulation)
    for _ in range(round(simulation.scene.warm_up / simulation.time_step)):
        state = advance(simulation, state)
    return 0, state
