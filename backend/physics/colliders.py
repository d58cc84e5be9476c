"""Solid things that particles cannot enter: each knows its signed distance, negative inside, and the way out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

Vector = tuple[float, float, float]


class Collider(Protocol):
    """A solid at rest. friction: share of the sliding speed that a touching particle loses a substep, 0 to 1."""

    @property
    def friction(self) -> float: ...

    def distances(
        self,
        positions: np.ndarray,  # [N, 3] m
    ) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance [N] m, negative inside, and the unit normals [N, 3] that point out of the solid."""
        ...


def _check_finite(name: str, *values: float) -> None:
    if not all(math.isfinite(value) for value in values):
        raise ValueError(f"{name} holds NaN or infinity")


def _check_friction(friction: float) -> None:
    if not 0.0 <= friction <= 1.0:
        raise ValueError(f"friction = {friction!r} is outside 0 to 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class HalfSpace:
    """Everything behind a plane: the ground, a wall. point m; normal points out of the solid, any length but 0."""

    point: Vector = (0.0, 0.0, 0.0)
    normal: Vector = (0.0, 0.0, 1.0)
    friction: float = 0.0

    def __post_init__(self) -> None:
        _check_finite("HalfSpace", *self.point, *self.normal)
        _check_friction(self.friction)
        if math.hypot(*self.normal) == 0.0:
            raise ValueError("the normal of a HalfSpace is zero")

    def distances(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        normal = np.array(self.normal) / math.hypot(*self.normal)
        return (positions - np.array(self.point)) @ normal, np.broadcast_to(normal, positions.shape)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sphere:
    """A ball. center m, radius m."""

    center: Vector
    radius: float
    friction: float = 0.0

    def __post_init__(self) -> None:
        _check_finite("Sphere", *self.center, self.radius)
        _check_friction(self.friction)
        if self.radius <= 0.0:
            raise ValueError(f"radius = {self.radius!r} is not positive")

    def distances(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        offsets = positions - np.array(self.center)
        lengths = np.sqrt(np.square(offsets).sum(axis=1))
        is_centre = lengths < 1e-12 * self.radius  # every way out is as good; up is taken
        safe = np.where(is_centre, 1.0, lengths)
        normals = np.where(is_centre[:, None], np.array([0.0, 0.0, 1.0]), offsets / safe[:, None])
        return lengths - self.radius, normals


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """A box along the axes. low, high: opposite corners, m."""

    low: Vector
    high: Vector
    friction: float = 0.0

    def __post_init__(self) -> None:
        _check_finite("Box", *self.low, *self.high)
        _check_friction(self.friction)
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(f"the box from {self.low} to {self.high} is empty")

    def distances(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        low, high = np.array(self.low), np.array(self.high)
        offsets = positions - 0.5 * (low + high)
        side = np.where(offsets < 0.0, -1.0, 1.0)
        beyond = np.abs(offsets) - 0.5 * (high - low)  # [N, 3] m, negative within the slab of an axis
        outside = np.maximum(beyond, 0.0)
        lengths = np.sqrt(np.square(outside).sum(axis=1))
        nearest = np.eye(3)[np.argmax(beyond, axis=1)]
        is_inside = lengths == 0.0
        directions = np.where(is_inside[:, None], nearest, outside / np.where(is_inside, 1.0, lengths)[:, None])
        return np.where(is_inside, beyond.max(axis=1), lengths), side * directions


def push_out(
    positions: np.ndarray,  # [N, 3] m
    colliders: Sequence[Collider],
) -> np.ndarray:  # [N, 3] m
    """Positions with those inside a solid moved to its surface. Later colliders have the last word."""
    for collider in colliders:
        distances, normals = collider.distances(positions)
        positions = positions - np.minimum(distances, 0.0)[:, None] * normals
    return positions


def deflect(
    velocities: np.ndarray,  # [N, 3] m/s
    positions: np.ndarray,  # [N, 3] m
    colliders: Sequence[Collider],
    *,
    margin: float,  # m, how near counts as touching
) -> np.ndarray:  # [N, 3] m/s
    """Velocities without the part that leads into a solid that is touched, and with the sliding part slowed by friction."""
    for collider in colliders:
        distances, normals = collider.distances(positions)
        inward = np.minimum((velocities * normals).sum(axis=1), 0.0)
        is_hit = (distances <= margin) & (inward < 0.0)
        sliding = velocities - (velocities * normals).sum(axis=1, keepdims=True) * normals
        velocities = np.where(is_hit[:, None], (1.0 - collider.friction) * sliding, velocities)
    return velocities
