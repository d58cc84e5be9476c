"""What the fit carries from frame to frame. Each record holds all that the next frame depends on."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from backend.io.particles import ParticleFrame


@dataclass(frozen=True, slots=True, kw_only=True)
class VolumeRecord:
    """What the prior proposes for a frame, on the voxels of a grid that stands before its camera.

    The units are the records' own, so that half precision does for scenes of any size and pace.
    """

    density: np.ndarray  # [X, Y, Z] float16 or float32, density_unit
    velocity: np.ndarray  # [X, Y, Z, 3] float16 or float32, velocity_unit, along the world's axes
    from_world: np.ndarray  # [4, 4] float64: the world to the grid's own axes, whose zero is its middle
    voxel_size: np.ndarray  # [] float64 m
    density_unit: np.ndarray = field(default_factory=lambda: np.asarray(1.0))  # [] float64 1/m
    velocity_unit: np.ndarray = field(default_factory=lambda: np.asarray(1.0))  # [] float64 m/s


@dataclass(frozen=True, slots=True, kw_only=True)
class PhysicalRecord:
    """The physical particles of a frame, and what was learned about the fluid up to it."""

    positions: np.ndarray  # [N, 3] float64 m
    velocities: np.ndarray  # [N, 3] float64 m/s
    masses: np.ndarray  # [N] float64 m^2, the optical mass that each one stands for
    ids: np.ndarray  # [N] int64, never used twice
    born: np.ndarray  # [N] int32, frame
    next_id: np.ndarray  # [] int64
    smoothing_length: np.ndarray  # [] float64 m
    rest_density: np.ndarray  # [] float64
    buoyancy: np.ndarray  # [3] float64 m/s^2, learned so far
    buoyancy_weight: np.ndarray  # [] float64, observations so far
    buoyancy_moment: np.ndarray  # [3] float64 m/s^2, their sum
    buoyancy_square: np.ndarray  # [3] float64 m^2/s^4, the sum of their squares
    gain: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [3] float64 m/s, see lift.py, summed over the observations
    gain_square: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [3] float64 m^2/s^2, the sum of their squares
    drift: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [3] float64 m/s^2, learned force that is not buoyancy


@dataclass(frozen=True, slots=True, kw_only=True)
class VisualRecord:
    """The Gaussians of a frame."""

    positions: np.ndarray  # [N, 3] float64 m
    velocities: np.ndarray  # [N, 3] float32 m/s
    scales: np.ndarray  # [N] float32 m, standard deviation; [N, 3] along the own axes where there are rotations
    optical_masses: np.ndarray  # [N] float32 m^2
    colors: np.ndarray  # [N, 3] float32 linear
    ids: np.ndarray  # [N] int64, never used twice
    born: np.ndarray  # [N] int32, frame
    next_id: np.ndarray  # [] int64
    rotations: np.ndarray | None = None  # [N, 4] float32 unit quaternions w x y z, own axes -> world; None: all are round


def particle_frame(record: VisualRecord) -> ParticleFrame:
    """The record as the asset holds it."""
    return ParticleFrame(
        positions=record.positions,
        velocities=record.velocities,
        scales=record.scales,
        optical_masses=record.optical_masses,
        colors=record.colors,
        ids=record.ids,
        rotations=record.rotations,
    )
