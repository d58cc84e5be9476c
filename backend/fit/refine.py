"""Gradient refinement of Gaussians against one frame: positions, scales, masses, colours together, by Adam.

Loss: mean squared error of premultiplied colour and opacity, which is what input-view PSNR measures, plus a pull of
each position to where the flow carried it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from backend.fit.adam import Adam
from backend.fit.population import not_grown_beside
from backend.fit.state import VisualRecord
from backend.geometry.camera import View
from backend.render import splat as renderer
from backend.render.composite import composite, composite_backward
from backend.render.gaussians import Gaussians, isotropic

POSITION_STEP = 0.075  # of the scale at birth, an iteration
LOG_STEP = 0.0225  # of log mass, an iteration: what the picture says of it the updates before have taken already
LOG_SCALE_STEP = 0.03
COLOR_STEP = 0.03
FLOOR = 0.2  # of Adam's: what hardly matters to this picture hardly moves, for it may matter to others
POSITION_PULL = 0.05  # strength of the pull to the carried position, in units of the data term's own gradient
SCALE_RANGE = (0.5, 3.0)  # of the scale at birth


def as_gaussians(record: VisualRecord) -> Gaussians:
    """The record as the renderer knows it."""
    if record.rotations is not None:
        return Gaussians(
            positions=record.positions,
            scales=record.scales,
            rotations=record.rotations,
            optical_masses=record.optical_masses,
            colors=record.colors,
        )
    return isotropic(record.positions, record.scales, record.optical_masses, record.colors)


def refine(
    record: VisualRecord,
    layer: np.ndarray,  # [H, W, 4] premultiplied linear RGB and opacity
    view: View,
    *,
    iterations: int,
    reference_scale: float,  # m, the scale of a particle at birth
    hue: np.ndarray | None = None,  # [3] linear: all smoke is of this colour, only brighter or darker; None: of any colour
) -> tuple[VisualRecord, float]:
    """The refined record and the loss before the last step."""
    if len(record.positions) == 0:
        return record, float(np.square(layer, dtype=np.float64).mean())
    channels = None if hue is None else _along(hue)
    target = _seen_through(layer, channels)
    carried = record.positions
    scales = record.scales.astype(np.float64)
    log_masses = np.log(np.maximum(record.optical_masses.astype(np.float64), 1e-30))
    colors = record.colors.astype(np.float64) if channels is None else record.colors.astype(np.float64) @ channels.T
    positions = carried.copy()
    steps = {
        "positions": (positions, POSITION_STEP * reference_scale),
        "scales": (scales, LOG_SCALE_STEP),
        "masses": (log_masses, LOG_STEP),
        "colors": (colors, COLOR_STEP * (3.0 / colors.shape[1]) ** 0.5),  # as far as three equal channels go
    }
    adam = {name: Adam.like(values, step, floor=FLOOR) for name, (values, step) in steps.items()}
    loss = 0.0
    for _ in range(iterations):
        current = replace(
            record,
            positions=positions,
            scales=scales.astype(np.float32),
            optical_masses=np.exp(log_masses).astype(np.float32),
        )
        splat = renderer.forward(as_gaussians(current), view, features=colors.astype(np.float32))
        shown, opacity = composite(splat.image)  # [channels, H, W], [H, W]
        color_error, opacity_error = shown - target[:-1], opacity - target[-1]
        loss = float(np.square(color_error, dtype=np.float64).mean() + np.square(opacity_error, dtype=np.float64).mean())
        gradients = renderer.backward(splat, composite_backward(splat.image, color_error, opacity_error))
        pull = (positions - carried) / reference_scale
        slope = np.asarray(gradients.positions, np.float64)
        slope = slope + POSITION_PULL * float(np.abs(slope).mean()) * pull
        positions = positions + adam["positions"].change(slope)
        scale_slope = np.asarray(gradients.scales, np.float64).sum(axis=1) * scales
        scales = np.clip(
            scales * np.exp(adam["scales"].change(scale_slope)),
            SCALE_RANGE[0] * reference_scale,
            SCALE_RANGE[1] * reference_scale,
        )
        log_masses = log_masses + adam["masses"].change(np.asarray(gradients.optical_masses) * np.exp(log_masses))
        colors = np.maximum(colors + adam["colors"].change(np.asarray(gradients.features, np.float64)), 0.0)
    masses = not_grown_beside(np.exp(log_masses).astype(np.float32), record.optical_masses, carried, view)
    refined = replace(
        record,
        positions=positions,
        scales=scales.astype(np.float32),
        optical_masses=masses,
        colors=(colors if channels is None else colors @ channels).astype(np.float32),
    )
    return refined, loss


def _along(hue: np.ndarray) -> np.ndarray:
    """[1, 3]: the direction of a colour, on which colours are measured."""
    return (np.asarray(hue, np.float64) / max(float(np.linalg.norm(hue)), 1e-12))[None]


def _seen_through(layer: np.ndarray, channels: np.ndarray | None) -> np.ndarray:
    """[H, W, 4] -> [channels + 1, H, W] float32: what the fit has to show, the opacity last."""
    if channels is None:
        return np.ascontiguousarray(np.moveaxis(layer, -1, 0), np.float32)
    light = np.moveaxis(layer[..., :3] @ channels.T.astype(np.float32), -1, 0)
    return np.concatenate([light, layer[None, ..., 3]]).astype(np.float32)
