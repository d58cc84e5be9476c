"""One step of the smoke, and the run of a scene.

Order of a step (Stam 1999, Fedkiw 2001): sources, forces, projection, transport of smoke and heat, advection of velocity,
projection. Smoke moves with a velocity that is free of divergence, so that what goes in comes out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from synthetic.scenes import Obstacle, SmokeScene, Source
from synthetic.solver.fields import Grid, SmokeState, centred_velocity, optical_mass
from synthetic.solver.forces import add_to_faces, buoyancy, vorticity_confinement
from synthetic.solver.momentum import advect_velocity
from synthetic.solver.noise import SourceNoise
from synthetic.solver.pressure import Velocity, open_faces_of, project
from synthetic.solver.transport import transport

_SOURCE_TIME = 0.08  # s, in which a source fills up; the exit velocity is reached in the same time
_WIND_EXPONENT = 1 / 7  # power law of the wind over open ground, Counihan 1975


@dataclass(frozen=True, slots=True, kw_only=True)
class Simulation:
    """What stays the same over a run."""

    scene: SmokeScene
    grid: Grid
    time_step: float  # s
    wind: np.ndarray  # [nz, 2] m/s
    open_faces: Velocity | None
    air: np.ndarray | None  # [nx, ny, nz] 1 in air, 0 in an obstacle; None without obstacles
    noises: tuple[SourceNoise, ...]


def prepare(scene: SmokeScene, *, voxel_size: float, time_step: float) -> Simulation:
    """The grid, wind and obstacles of a scene at a resolution. time_step in s."""
    if not (time_step > 0 and voxel_size > 0):
        raise ValueError(f"time_step {time_step} and voxel_size {voxel_size} must be positive")
    nx, ny, nz = (max(4, round(length / voxel_size)) for length in scene.size)
    origin = (scene.centre[0] - 0.5 * nx * voxel_size, scene.centre[1] - 0.5 * ny * voxel_size, 0.0)
    grid = Grid(nx=nx, ny=ny, nz=nz, voxel_size=voxel_size, origin=origin)
    height = grid.centres()[2]
    wind = np.outer((height / 10.0) ** _WIND_EXPONENT, scene.wind).astype(np.float32)
    solid = _solid_cells(grid, scene.obstacles)
    return Simulation(
        scene=scene,
        grid=grid,
        time_step=time_step,
        wind=wind,
        open_faces=open_faces_of(solid) if solid.any() else None,
        air=(~solid).astype(np.float32) if solid.any() else None,
        noises=tuple(
            SourceNoise(seed=scene.seed * 1000 + index, radius=source.radius) for index, source in enumerate(scene.sources)
        ),
    )


def begin(simulation: Simulation) -> SmokeState:
    """Clean air in the wind."""
    grid, wind = simulation.grid, simulation.wind
    nx, ny, nz = grid.shape
    velocity = (
        np.broadcast_to(wind[:, 0], (nx + 1, ny, nz)).copy(),
        np.broadcast_to(wind[:, 1], (nx, ny + 1, nz)).copy(),
        np.zeros((nx, ny, nz + 1), np.float32),
    )
    u, v, w = project(velocity, open_faces=simulation.open_faces)
    empty = np.zeros(grid.shape, np.float32)
    return SmokeState(time=0.0, density=empty, temperature=empty.copy(), u=u, v=v, w=w, emitted=0.0, left=0.0)


def advance(simulation: Simulation, state: SmokeState) -> SmokeState:
    """The state one time step later."""
    scene, grid, step = simulation.scene, simulation.grid, simulation.time_step
    density, temperature, push = _add_sources(simulation, state)
    emitted = state.emitted + optical_mass(density, voxel_size=grid.voxel_size)
    emitted -= optical_mass(state.density, voxel_size=grid.voxel_size)

    acceleration = vorticity_confinement(centred_velocity(state), strength=scene.confinement, voxel_size=grid.voxel_size)
    acceleration += push
    acceleration[..., 2] += buoyancy(temperature)
    velocity = add_to_faces((state.u, state.v, state.w), acceleration, time_step=step)
    velocity = project(velocity, open_faces=simulation.open_faces)

    density, left = transport(density, velocity, time_step=step, voxel_size=grid.voxel_size)
    temperature, _ = transport(temperature, velocity, time_step=step, voxel_size=grid.voxel_size)
    temperature *= np.float32(math.exp(-step / scene.cooling))
    velocity = advect_velocity(velocity, simulation.wind, cells=step / grid.voxel_size)
    u, v, w = project(velocity, open_faces=simulation.open_faces)
    return replace(
        state,
        time=state.time + step,
        density=density,
        temperature=temperature,
        u=u,
        v=v,
        w=w,
        emitted=emitted,
        left=state.left + left,
    )


def run(simulation: Simulation, *, num_frames: int, fps: float) -> Iterator[SmokeState]:
    """The state at each frame: frame 0 after the scene's warm-up. The time step must divide the frame's duration."""
    per_frame = round(1 / (fps * simulation.time_step))
    if per_frame < 1 or abs(per_frame * simulation.time_step * fps - 1) > 1e-6:
        raise ValueError(f"{simulation.time_step} s does not divide a frame of {fps} a second")
    state = begin(simulation)
    for _ in range(round(simulation.scene.warm_up / simulation.time_step)):
        state = advance(simulation, state)
    for frame in range(num_frames):
        yield state
        for _ in range(per_frame if frame < num_frames - 1 else 0):
            state = advance(simulation, state)


def _add_sources(simulation: Simulation, state: SmokeState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Density and temperature after the sources burned for a step, and the acceleration they give the air."""
    density, temperature = state.density.copy(), state.temperature.copy()
    push = np.zeros((*density.shape, 3), np.float32)
    share = np.float32(1 - math.exp(-simulation.time_step / _SOURCE_TIME))
    for source, noise in zip(simulation.scene.sources, simulation.noises, strict=True):
        if not source.start <= state.time < source.stop:
            continue
        box, positions, weight = _source_cells(simulation.grid, source)
        if simulation.air is not None:
            weight = weight * simulation.air[box]
        strength = np.clip(1 + source.noise * noise.flicker(positions, state.time), 0, 2) * weight
        strength = strength.astype(np.float32)
        density[box] += share * np.maximum(source.density * strength - density[box], 0)
        temperature[box] += share * np.maximum(source.temperature * strength - temperature[box], 0)
        push[box] += (source.turbulence * weight[..., None] * noise.stirring(positions, state.time)).astype(np.float32)
        risen = 0.5 * (state.w[:, :, 1:] + state.w[:, :, :-1])[box]
        push[box][..., 2] += share / np.float32(simulation.time_step) * weight * np.maximum(source.rise - risen, 0)
    return density, temperature, push


def _source_cells(grid: Grid, source: Source) -> tuple[tuple[slice, ...], np.ndarray, np.ndarray]:
    """The box of cells around a source, their centres [.., 3] m and weights [..]: 1 inside, 0 one cell beyond."""
    axes = grid.centres()
    reach = source.radius + grid.voxel_size
    slices, coordinates = [], []
    for centres, middle in zip(axes, source.position, strict=True):
        inside = np.flatnonzero(np.abs(centres - middle) <= reach)
        if inside.size == 0:
            raise ValueError(f"the source at {source.position} lies outside the grid")
        slices.append(slice(int(inside[0]), int(inside[-1]) + 1))
        coordinates.append(centres[inside])
    positions = np.stack(np.meshgrid(*coordinates, indexing="ij"), axis=-1)
    distance = np.linalg.norm(positions - np.asarray(source.position), axis=-1)
    weight = np.clip((source.radius - distance) / grid.voxel_size + 0.5, 0, 1).astype(np.float32)
    return tuple(slices), positions, weight


def _solid_cells(grid: Grid, obstacles: tuple[Obstacle, ...]) -> np.ndarray:
    """Cells whose centre lies in an obstacle [nx, ny, nz]."""
    x, y, z = np.meshgrid(*grid.centres(), indexing="ij")
    solid = np.zeros(grid.shape, bool)
    for obstacle in obstacles:
        is_in = [(c >= a) & (c < b) for c, a, b in zip((x, y, z), obstacle.low, obstacle.high, strict=True)]
        solid |= is_in[0] & is_in[1] & is_in[2]
    return solid
