"""Optical depth of a Gaussian along every pixel's ray, exactly: no projection, no approximation. Float64."""

from __future__ import annotations

import numpy as np

from backend.geometry.camera import View


def optical_depth(view: View, position: np.ndarray, covariance: np.ndarray, optical_mass: float) -> np.ndarray:
    """[H, W]: integral over s of optical_mass * Normal(camera + s d; position [3], covariance [3, 3]), d of unit length.

    With P the inverse covariance and e = position - camera: the exponent is a parabola in s with curvature d P d, and its
    integral is exp(-(e P e - (d P e)^2 / (d P d)) / 2) sqrt(2 pi / (d P d)).
    """
    columns, rows = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    directions = np.stack([(columns - view.cx) / view.fx, (rows - view.cy) / view.fy, np.ones_like(rows)], axis=-1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    directions = directions @ view.camera_to_world[:3, :3].T
    inverse = np.linalg.inv(covariance)
    e = position - view.position
    along = directions @ inverse @ e
    curvature = np.einsum("hwi,ij,hwj->hw", directions, inverse, directions)
    peak = optical_mass / np.sqrt((2 * np.pi) ** 3 * np.linalg.det(covariance))
    return peak * np.exp(-0.5 * (e @ inverse @ e - along**2 / curvature)) * np.sqrt(2 * np.pi / curvature)
