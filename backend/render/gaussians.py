"""Gaussian smoke particles: the arrays that the renderer takes, checked once where they enter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Gaussians:
    """N anisotropic Gaussians of extinction: density_i(x) = optical_masses_i * Normal(x; positions_i, covariance_i) in 1/m.

    Covariance_i = R S S R^T with R from rotations_i and S = diag(scales_i). Quaternions need not have unit length: they are
    divided by it. Raises ValueError, naming the array, on a wrong shape, a number that is not finite, a negative scale or
    mass, or a quaternion of length zero.
    """

    positions: np.ndarray  # [N, 3] m
    scales: np.ndarray  # [N, 3] m, standard deviations
    rotations: np.ndarray  # [N, 4] quaternions w x y z, local to world
    optical_masses: np.ndarray  # [N] m^2, extinction integrated over space
    colors: np.ndarray  # [N, 3] linear RGB

    def __post_init__(self) -> None:
        num = len(self.positions)
        shapes = {"positions": (num, 3), "scales": (num, 3), "rotations": (num, 4), "optical_masses": (num,), "colors": (num, 3)}
        for name, shape in shapes.items():
            require_finite(name, getattr(self, name), shape)
        for name in ("scales", "optical_masses"):
            if num and np.min(getattr(self, name)) < 0:
                raise ValueError(f"{name} holds negative numbers")
        if num and np.min(np.max(np.abs(self.rotations), axis=1)) < 1e-20:
            raise ValueError("rotations holds a quaternion of length zero")

    def __len__(self) -> int:
        return len(self.positions)


def require_finite(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    """Raises ValueError, with the array's name, unless it has this shape and holds finite numbers only."""
    if not isinstance(array, np.ndarray) or array.shape != shape:
        raise ValueError(f"{name} has shape {getattr(array, 'shape', None)}, not {shape}")
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} holds {array.dtype}, not real numbers")
    # The sum is finite whenever all numbers are (unless it overflows) and needs no temporary of the array's size.
    with np.errstate(over="ignore", invalid="ignore"):
        suspicious = not np.isfinite(np.sum(array, dtype=np.float64))
    if suspicious and not np.isfinite(array).all():
        raise ValueError(f"{name} holds NaN or infinity")


def isotropic(
    positions: np.ndarray, scales: np.ndarray, optical_masses: np.ndarray, colors: np.ndarray | None = None
) -> Gaussians:
    """Round Gaussians: positions [N, 3] m, scales [N] m, optical_masses [N] m^2, colors [N, 3] linear (white without)."""
    num = len(positions)
    return Gaussians(
        positions=positions,
        scales=np.repeat(np.asarray(scales)[:, None], 3, axis=1),
        rotations=np.tile(np.array([1.0, 0.0, 0.0, 0.0]), (num, 1)),
        optical_masses=optical_masses,
        colors=np.ones((num, 3), np.float32) if colors is None else colors,
    )
