"""A source of particles. Which particle is born when and where is fixed by its number alone, however time is cut."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .colliders import Vector
from .state import FluidState

_MOST = 10_000_000  # particles at once; more is a mistake in the rate


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A ball that particles leave. position m; radius m; rate particles/s; velocity m/s.

    mass: of each particle. first_id: of the first particle; the k-th has first_id + k. seed: of the places.
    """

    position: Vector
    radius: float
    rate: float
    velocity: Vector = (0.0, 0.0, 0.0)
    mass: float = 1.0
    first_id: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        numbers = (*self.position, *self.velocity, self.radius, self.rate, self.mass)
        if not all(math.isfinite(number) for number in numbers) or self.radius < 0.0 or self.rate < 0.0:
            raise ValueError(f"{self} holds a negative, infinite or undefined number")


def emit(
    source: Source,
    start: float,  # s
    stop: float,  # s
    *,
    frame: int,
) -> FluidState:
    """The particles born in start <= t < stop, where they are at `stop`. The k-th is born at (k + 1/2) / rate."""
    if not (math.isfinite(start) and math.isfinite(stop) and 0.0 <= start <= stop):
        raise ValueError(f"{start!r} to {stop!r} s is no span of time")
    first, last = math.ceil(start * source.rate - 0.5), math.ceil(stop * source.rate - 0.5)
    if last - first > _MOST:
        raise ValueError(f"{last - first} particles at once are more than {_MOST}")
    numbers = np.arange(first, last, dtype=np.int64)
    ages = stop - (numbers + 0.5) / source.rate if len(numbers) else np.zeros(0)  # s
    places = np.array(source.position) + source.radius * places_in_ball(numbers, seed=source.seed)
    return FluidState(
        positions=places + ages[:, None] * np.array(source.velocity),
        velocities=np.broadcast_to(np.array(source.velocity), places.shape).copy(),
        masses=np.full(len(numbers), source.mass),
        ids=source.first_id + numbers,
        born=np.full(len(numbers), frame, np.int32),
    )


def joined(state: FluidState, newborn: FluidState) -> FluidState:
    """Both together, the newborn behind."""
    names = ("positions", "velocities", "masses", "ids", "born")
    return FluidState(**{name: np.concatenate([getattr(state, name), getattr(newborn, name)]) for name in names})


def places_in_ball(
    numbers: np.ndarray,  # [K] int64
    *,
    seed: int,
) -> np.ndarray:  # [K, 3], in the unit ball
    """A place for each number, evenly spread over the ball's volume."""
    height, turn, depth = (_uniform(numbers, seed, channel) for channel in range(3))
    z = 2.0 * height - 1.0
    flat = np.sqrt(1.0 - z * z)
    directions = np.stack([flat * np.cos(2.0 * np.pi * turn), flat * np.sin(2.0 * np.pi * turn), z], axis=1)
    return np.cbrt(depth)[:, None] * directions


def _uniform(numbers: np.ndarray, seed: int, channel: int) -> np.ndarray:
    """A float in 0 .. 1 per number: splitmix64 (Steele et al. 2014) as a hash."""
    with np.errstate(over="ignore"):
        state = np.asarray(numbers).astype(np.uint64) * np.uint64(3) + np.uint64(channel)
        for salt in (np.uint64(seed % 2**64), np.uint64(0)):
            state = (state + salt + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
            state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            state = state ^ (state >> np.uint64(31))
    return (state >> np.uint64(11)).astype(np.float64) / float(2**53)
