"""How well particles explain a frame, and what to change: their masses, their colours, who is missing, who is done."""

from __future__ import annotations

import numpy as np

from backend.render import splat as renderer

FLOOR = 1e-3  # optical depth that one 8-bit step of opacity cannot show; keeps ratios of nothing to nothing at one
MAX_RATIO = 8.0


def fit_masses(
    splat: renderer.Splat,
    masses: np.ndarray,  # [N] m^2, carried from the frame before
    target: np.ndarray,  # [H, W] optical depth
    *,
    iterations: int,
    consistency: float,  # 0 forgets the carried masses, 1 keeps them
) -> tuple[renderer.Splat, np.ndarray]:
    """Multiplicative expectation-maximisation of a non-negative linear model (Richardson 1972, Lucy 1974).

    m_i <- m_i (A^T (target / A m))_i / (A^T 1)_i, then m_i <- carried^c m_i^(1 - c). A particle outside the image
    keeps its mass. Returns the splat at the new masses and the masses [N].
    """
    carried = np.asarray(masses, np.float64)
    ones = np.ones(target.shape, np.float32)
    coverage = renderer.adjoint_mass(splat, ones).astype(np.float64)
    is_seen = coverage > 1e-12
    current = carried.copy()
    for _ in range(iterations):
        ratio = np.minimum((target + FLOOR) / (splat.image[0] + FLOOR), MAX_RATIO).astype(np.float32)
        factor = np.where(is_seen, renderer.adjoint_mass(splat, ratio) / np.where(is_seen, coverage, 1.0), 1.0)
        current = current * np.maximum(factor, 0.0)
        splat = renderer.reweighted(splat, current.astype(np.float32))
    if consistency > 0.0:
        tiny = 1e-30
        current = np.exp(consistency * np.log(carried + tiny) + (1.0 - consistency) * np.log(current + tiny))
        splat = renderer.reweighted(splat, current.astype(np.float32))
    return splat, current.astype(np.float32)


def missing_depth(splat: renderer.Splat, target: np.ndarray) -> np.ndarray:
    """Optical depth [H, W] that no particle explains."""
    return np.maximum(target - splat.image[0], 0.0)
