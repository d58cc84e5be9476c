"""Buoyancy learned from what the observations changed about the velocities: strength and direction, in closed form.

Symbols: v0, v1 velocities [m/s] before and after a step of dt [s], b buoyancy [m/s^2], k drag [1/s], w wind [m/s].
The fluid's step (fluid.py) without pressure, in n substeps of s = dt / n, is linear in b:

    v1 = a^n v0 + (a + ... + a^n) s (b + k w),   a = 1 / (1 + k s)

Each particle that was observed gives one b; pressure only moves momentum from one particle to another and drops out of
their mean. A loss on density cannot see b at all, since density does not change when everything moves alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .colliders import Vector


@dataclass(frozen=True, slots=True, kw_only=True)
class Buoyancy:
    """vector: m/s^2, [3]. covariance: of the vector, m^2/s^4, [3, 3]; infinite where nothing was observed."""

    vector: np.ndarray
    covariance: np.ndarray

    @property
    def strength(self) -> float:  # m/s^2
        return float(np.linalg.norm(self.vector))

    @property
    def direction(self) -> np.ndarray:  # [3]
        """Unit vector; 0 without buoyancy."""
        strength = self.strength
        return self.vector / strength if strength > 0.0 else np.zeros(3)

    @property
    def strength_deviation(self) -> float:  # m/s^2
        """Standard deviation of the strength; of the strongest axis if the strength is 0."""
        if not np.isfinite(self.covariance).all():
            return math.inf
        variances = np.linalg.eigvalsh(self.covariance)
        along = float(self.direction @ self.covariance @ self.direction) if self.strength > 0.0 else float(variances[-1])
        return math.sqrt(max(along, 0.0))

    @property
    def angle_deviation(self) -> float:  # rad
        """Standard deviation of the direction, at most pi."""
        if not np.isfinite(self.covariance).all() or self.strength == 0.0:
            return math.pi
        across = np.trace(self.covariance) - self.direction @ self.covariance @ self.direction
        return min(math.pi, math.sqrt(max(float(across), 0.0)) / self.strength)


def solve_buoyancy(
    velocities_before: np.ndarray,  # [N, 3] m/s
    velocities_after: np.ndarray,  # [N, 3] m/s, as observed
    weights: np.ndarray,  # [N], how far each particle's observation counts, not negative
    dt: float,  # s
    *,
    drag: float = 0.0,  # 1/s
    wind: Vector = (0.0, 0.0, 0.0),  # m/s
    substeps: int = 1,
    prior: Vector = (0.0, 0.0, 0.0),  # m/s^2
    prior_weight: float = 0.0,  # in units of the weights
    num_independent: float | None = None,  # at most this many observations are independent; None: all
) -> Buoyancy:
    """Weighted least squares with a ridge towards the prior: sum_i w_i |b_i - b|^2 + w_prior |prior - b|^2 -> min.

    Frames are learned from together by stacking their particles. Without weight and prior weight: the prior, of which
    nothing is known.
    """
    observed = _observed_buoyancy(velocities_before, velocities_after, dt, drag=drag, wind=wind, substeps=substeps)
    weights = np.asarray(weights, np.float64)
    if weights.shape != (len(observed),) or not np.isfinite(weights).all() or np.any(weights < 0.0):
        raise ValueError("weights are not [N] finite numbers of at least 0")
    if not (np.isfinite(prior).all() and math.isfinite(prior_weight) and prior_weight >= 0.0):
        raise ValueError("the prior holds NaN, infinity or a negative weight")
    scale = float(weights.max(initial=0.0))
    if scale == 0.0:
        return Buoyancy(vector=np.array(prior, np.float64), covariance=np.full((3, 3), math.inf))
    weights, prior_weight = weights / scale, prior_weight / scale
    total = float(weights.sum())
    vector = ((weights[:, None] * observed).sum(axis=0) + prior_weight * np.array(prior)) / (total + prior_weight)
    return Buoyancy(vector=vector, covariance=_covariance(observed, weights, prior_weight, num_independent))


def _covariance(
    observed: np.ndarray,  # [N, 3]
    weights: np.ndarray,  # [N], at most 1
    prior_weight: float,
    num_independent: float | None,
) -> np.ndarray:  # [3, 3]
    """Of the weighted mean: the spread of the observations over their effective number, shrunk as the ridge shrinks."""
    total = float(weights.sum())
    effective = total * total / float((weights * weights).sum())
    if num_independent is not None:
        effective = min(effective, num_independent)
    if effective <= 1.0 + 1e-9:
        return np.full((3, 3), math.inf)
    residuals = observed - (weights[:, None] * observed).sum(axis=0) / total
    spread = np.einsum("n,ni,nj->ij", weights, residuals, residuals) / total
    return spread / (effective - 1.0) * (total / (total + prior_weight)) ** 2


def _observed_buoyancy(
    before: np.ndarray,  # [N, 3] m/s
    after: np.ndarray,  # [N, 3] m/s
    dt: float,  # s
    *,
    drag: float,
    wind: Vector,
    substeps: int,
) -> np.ndarray:  # [N, 3] m/s^2
    """The buoyancy that would take each particle from one velocity to the other."""
    before, after = np.asarray(before, np.float64), np.asarray(after, np.float64)
    if before.ndim != 2 or before.shape[1] != 3 or before.shape != after.shape:
        raise ValueError(f"velocities have shapes {before.shape} and {after.shape}, not both [N, 3]")
    if not (np.isfinite(before).all() and np.isfinite(after).all() and np.isfinite(wind).all()):
        raise ValueError("velocities or wind hold NaN or infinity")
    if not (math.isfinite(dt) and dt > 0.0 and math.isfinite(drag) and drag >= 0.0 and substeps >= 1):
        raise ValueError(f"dt = {dt!r}, drag = {drag!r} or substeps = {substeps!r} is out of range")
    seconds = dt / substeps
    decay = 1.0 / (1.0 + drag * seconds)
    duration = seconds * sum(decay**n for n in range(1, substeps + 1))
    return (after - decay**substeps * before) / duration - drag * np.array(wind)
