"""What lifts smoke, told apart from what blows it: dense smoke against the thinner smoke beside it.

Heat lifts smoke as much as there is of it (Boussinesq 1903); drag and wind take hold of all of it alike. Where both balance,
v = w + (b / k) rho / mean(rho): what velocity gains with density, among neighbours, lies along the buoyancy b, whatever the
wind w is. The mean force, in which buoyancy and wind are one, is then shared out: its part along that axis is buoyancy, and
the rest is what the wind's drag does.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from backend.fit.state import PhysicalRecord

BESIDE = 4.0  # voxels, standard deviation of what is beside: wider than a plume's core, narrower than its bends
_SHARED = 30.0  # frames that a proposal shares images with: what they say together counts as one observation
_FAINT = 0.02  # of the largest density: thinner smoke is not compared


def gain_with_density(density: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """[3] m/s: what velocity [X, Y, Z, 3] m/s gains where density [X, Y, Z] is higher than beside it by the mean density.

    The slope of a weighted regression within neighbourhoods; zero where density is even, or where there is no smoke.
    """
    exact = np.asarray(density, np.float64)
    inside = exact > _FAINT * max(float(exact.max(initial=0.0)), 1e-30)
    share = _around(inside.astype(np.float64))
    if not inside.any():
        return np.zeros(3)
    mean = float(exact[inside].mean())
    denser = _less_neighbours(exact / mean, inside, share)
    total = float(np.square(denser).sum())
    if not total > 1e-9 * inside.sum():
        return np.zeros(3)
    faster = [_less_neighbours(np.asarray(velocity[..., axis], np.float64), inside, share) for axis in range(3)]
    return np.array([float((denser * part).sum()) / total for part in faster])


def shared_out(force: np.ndarray, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A mean force [3] m/s^2 as buoyancy [3], along the gain [3], and the rest [3]; without a gain all is buoyancy."""
    size = float(np.linalg.norm(gain))
    if not size > 0.0:
        return force.copy(), np.zeros(3)
    axis = gain / size
    buoyancy = float(axis @ force) * axis
    return buoyancy, force - buoyancy


def buoyancy_of(record: PhysicalRecord) -> tuple[np.ndarray, np.ndarray]:
    """The learned buoyancy [3] and its standard deviation [3], m/s^2; infinite doubt is reported as the estimate's own size.

    Along the axis that of the force; across it what the frames disagree about the axis.
    """
    count = float(record.buoyancy_weight)
    if count < 2.0:
        return record.buoyancy, np.abs(record.buoyancy)
    variance = _of_mean(record.buoyancy_moment, record.buoyancy_square, count)
    size, strength = float(np.linalg.norm(record.gain)), float(np.linalg.norm(record.buoyancy))
    if size > 0.0:
        axis = record.gain / size
        independent = max(count / _SHARED, 2.0)
        turned = strength**2 * _of_mean(record.gain, record.gain_square, count, independent) * (count / size) ** 2
        variance = np.square(axis) * float(np.square(axis) @ variance) + (1.0 - np.square(axis)) * turned
    return record.buoyancy, np.sqrt(variance)


def wind_of(record: PhysicalRecord, *, drag: float) -> np.ndarray:
    """[3] m/s: the wind whose drag [1/s] is the part of the learned force that is not buoyancy."""
    return record.drift / drag if drag > 0.0 else np.zeros(3)


def _of_mean(total: np.ndarray, squares: np.ndarray, count: float, independent: float | None = None) -> np.ndarray:
    """Variances of a mean from the sums of what it is of, so many of which are independent; None: all."""
    mean = total / count
    return np.maximum(squares / count - mean * mean, 0.0) / ((independent or count) - 1.0)


def _around(values: np.ndarray) -> np.ndarray:
    return ndimage.gaussian_filter(values, BESIDE, mode="constant")


def _less_neighbours(values: np.ndarray, inside: np.ndarray, share: np.ndarray) -> np.ndarray:
    """[X, Y, Z]: values less the mean of the smoke around, inside; zero elsewhere."""
    around = _around(np.where(inside, values, 0.0)) / np.maximum(share, 1e-12)
    return np.where(inside, values - around, 0.0)
