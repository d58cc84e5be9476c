"""Gaussians ride on the physical particles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from backend.fit.state import PhysicalRecord, VisualRecord
from backend.physics.fluid import FluidState
from backend.physics.interpolate import interpolate_velocity


def as_fluid(record: PhysicalRecord, *, seconds_back: float = 0.0) -> FluidState:
    """The record as the fluid knows it, moved back along its velocities."""
    return FluidState(
        positions=record.positions - seconds_back * record.velocities,
        velocities=record.velocities,
        masses=record.masses,
        ids=record.ids,
        born=record.born,
    )


def carry(record: VisualRecord, fluid: PhysicalRecord, *, seconds: float) -> VisualRecord:
    """The Gaussians moved by one frame; `fluid` is the record of the frame that they arrive in.

    The physical velocities are those that led into that frame, so the midpoint rule takes them half a frame back.
    """
    if len(record.positions) == 0 or len(fluid.positions) == 0:
        return record
    length = float(fluid.smoothing_length)
    begin = interpolate_velocity(record.positions, as_fluid(fluid, seconds_back=seconds), length)[0]
    middle = record.positions + 0.5 * seconds * begin
    velocity = interpolate_velocity(middle, as_fluid(fluid, seconds_back=0.5 * seconds), length)[0]
    return replace(record, positions=record.positions + seconds * velocity)


def with_velocities(record: VisualRecord, fluid: PhysicalRecord) -> VisualRecord:
    """The Gaussians with the physical velocity where they are now."""
    if len(record.positions) == 0 or len(fluid.positions) == 0:
        return record
    velocities = interpolate_velocity(record.positions, as_fluid(fluid), float(fluid.smoothing_length))[0]
    return replace(record, velocities=velocities.astype(np.float32))
