"""From optical depth and its colour sums to what the eye sees: premultiplied colour and opacity."""

from __future__ import annotations

import numpy as np

from .gaussians import require_finite

_SERIES_BELOW = 0.02  # optical depth below which the difference quotients are taken from their series


def composite(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """image [1 + K, H, W] (optical depth, then feature sums) -> premultiplied features [K, H, W], opacity [H, W].

    opacity = 1 - exp(-tau); the colour of a pixel is the mean of its smoke, weighted by optical depth, times opacity.
    """
    tau = image[0]
    opacity = -np.expm1(-tau)
    return image[1:] * _quotient(tau, opacity), opacity


def composite_backward(image: np.ndarray, grad_features: np.ndarray | None, grad_opacity: np.ndarray | None) -> np.ndarray:
    """Gradient with respect to image [1 + K, H, W] from those of composite's two results (None: zero)."""
    grad = np.zeros_like(image)
    tau = image[0]
    if grad_opacity is not None:
        require_finite("grad_opacity", grad_opacity, tau.shape)
        grad[0] = grad_opacity * np.exp(-tau)
    if grad_features is not None:
        require_finite("grad_features", grad_features, image[1:].shape)
        grad[1:] = grad_features * _quotient(tau, -np.expm1(-tau))
        grad[0] += np.sum(grad_features * image[1:], axis=0) * _quotient_slope(tau)
    return grad


def _quotient(tau: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """opacity / tau, 1 at 0."""
    return np.divide(opacity, tau, out=np.ones_like(tau), where=tau > 1e-30)


def _quotient_slope(tau: np.ndarray) -> np.ndarray:
    """Derivative of _quotient: (exp(-tau) - quotient) / tau, -1/2 at 0; by its series where the difference cancels."""
    safe, small = np.maximum(tau, _SERIES_BELOW), np.minimum(tau, _SERIES_BELOW)
    series = -0.5 + small * (1 / 3 - small * (1 / 8 - small / 30))
    return np.where(tau < _SERIES_BELOW, series, (np.exp(-safe) - _quotient(safe, -np.expm1(-safe))) / safe).astype(tau.dtype)
