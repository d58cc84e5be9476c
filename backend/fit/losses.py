"""Losses between pictures, each with its gradient with respect to the first. Pictures are [K, H, W], any scale.

    reconstruction    0.8 L1 + 0.2 (1 - SSIM)                 Kerbl 2023, eq. 7; FluidNexus, WildSmoke
    frequency         amplitude and phase of the spectrum     WildSmoke, supplement 7.6.2, as published and corrected

Means are over all values. All in float64 inside; gradients are exact for what is computed and finite everywhere.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import correlate1d

L1_SHARE = 0.8
_WINDOW, _SIGMA = 11, 1.5  # px; Wang 2004
_C1, _C2 = 0.01**2, 0.03**2  # Wang 2004, for values 0..1
_TINY = 1e-12


def reconstruction(picture: np.ndarray, target: np.ndarray, *, l1_share: float = L1_SHARE) -> tuple[float, np.ndarray]:
    """l1_share |picture - target| + (1 - l1_share) (1 - SSIM), and its gradient."""
    near, near_slope = l1(picture, target)
    alike, alike_slope = structural_similarity(picture, target)
    return l1_share * near + (1 - l1_share) * (1 - alike), l1_share * near_slope - (1 - l1_share) * alike_slope


def l1(picture: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean absolute difference; its slope is 0 where the two are equal."""
    difference = _checked(picture, target)
    return float(np.abs(difference).mean()) if difference.size else 0.0, np.sign(difference) / max(difference.size, 1)


def structural_similarity(picture: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean SSIM (Wang 2004, eq. 13) with a Gaussian window of 11 px, what is outside taken as 0, and its gradient.

    With local means m, variances v and covariance c: SSIM = (2 mx my + C1)(2 c + C2) / ((mx^2 + my^2 + C1)(vx + vy + C2)).
    """
    _checked(picture, target)
    x, y = np.asarray(picture, np.float64), np.asarray(target, np.float64)
    if x.size == 0:
        return 1.0, np.zeros_like(x)
    mx, my = _blurred(x), _blurred(y)
    vx, vy, cov = _blurred(x * x) - mx * mx, _blurred(y * y) - my * my, _blurred(x * y) - mx * my
    a, b = 2 * mx * my + _C1, 2 * cov + _C2
    c, d = mx * mx + my * my + _C1, vx + vy + _C2
    value = a * b / (c * d)
    # Through the blurred x, x^2 and x y; the window is symmetric, so that the blur is its own adjoint.
    by_square = -value / d
    by_product = 2 * a / (c * d)
    by_mean = 2 * my * b / (c * d) - 2 * mx * value / c - 2 * mx * by_square - my * by_product
    gradient = _blurred(by_mean) + 2 * x * _blurred(by_square) + y * _blurred(by_product)
    return float(value.mean()), gradient / x.size


def frequency_as_published(picture: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray]:
    """mean | |F| - |F'| | + mean | angle F - angle F' |, F = FFT not scaled, the difference of angles not wrapped.

    As printed: a difference of nearly 2 pi counts as large although the angles are nearly equal, the phase of an empty bin is
    chance, and the amplitude's part grows with the picture. Where |F| is below 1e-12 the slopes are taken as 0.
    """
    if _checked(picture, target).size == 0:
        return 0.0, np.zeros(picture.shape)
    ours, theirs = (np.fft.fft2(np.asarray(values, np.float64)) for values in (picture, target))
    size = max(ours.size, 1)
    amplitude, difference = np.abs(ours), np.abs(ours) - np.abs(theirs)
    turned = np.angle(ours) - np.angle(theirs)
    value = (np.abs(difference).sum() + np.abs(turned).sum()) / size
    safe = np.where(amplitude > _TINY, amplitude, np.inf)
    # d|F| = Re(conj(F) dF) / |F|, d angle F = Im(conj(F) dF) / |F|^2
    bins = np.sign(difference) * ours / safe + 1j * np.sign(turned) * ours / safe**2
    return float(value), _back(bins / size)


def frequency(picture: np.ndarray, target: np.ndarray, *, band: tuple[float, float] = (0.125, 0.5)) -> tuple[float, np.ndarray]:
    """Mean |F - F'| over the bins with `band` cycles per px, F = FFT with norm "ortho": amplitude and phase in one number.

    The phase counts as much as there is amplitude, wraps by itself, and the value does not grow with the picture. Its slope is
    0 where the two spectra are equal. Raises ValueError for a band that holds no frequency of the picture.
    """
    difference = _checked(picture, target)
    if difference.size == 0:
        return 0.0, np.zeros(picture.shape)
    height, width = difference.shape[-2:]
    rows, columns = np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None]
    cycles = np.hypot(rows, columns)
    chosen = (cycles >= band[0]) & (cycles <= band[1])
    count = int(chosen.sum()) * difference.shape[0]
    if count == 0:
        raise ValueError(f"no frequency of a {width}x{height} picture lies in the band {band}")
    bins = np.fft.fft2(difference, norm="ortho") * chosen
    size = np.abs(bins)
    slope = np.divide(bins, size, out=np.zeros_like(bins), where=size > _TINY)
    return float(size.sum() / count), np.real(np.fft.ifft2(slope, norm="ortho")) / count


def warm_up(iteration: int, length: int) -> float:
    """min(1, iteration / length), supplement 7.6.2; 1 where length is 0."""
    return min(1.0, iteration / length) if length > 0 else 1.0


def _checked(picture: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The difference, float64. Raises ValueError where the two do not fit, or hold what is no number."""
    if picture.shape != target.shape or picture.ndim != 3:
        raise ValueError(f"pictures of {picture.shape} and {target.shape} cannot be compared; both must be [K, H, W]")
    difference = np.asarray(picture, np.float64) - np.asarray(target, np.float64)
    if not np.isfinite(difference).all():
        raise ValueError("a picture holds NaN or infinity")
    return difference


def _blurred(values: np.ndarray) -> np.ndarray:
    offsets = np.arange(_WINDOW) - _WINDOW // 2
    window = np.exp(-0.5 * (offsets / _SIGMA) ** 2)
    window /= window.sum()
    for axis in (-2, -1):
        values = correlate1d(values, window, axis=axis, mode="constant")
    return values


def _back(bins: np.ndarray) -> np.ndarray:
    """Gradient of a picture from that of its spectrum, given as d loss = sum of Re(conj(bins) dF), F = fft2 not scaled."""
    return np.real(np.fft.ifft2(bins, norm="forward"))
