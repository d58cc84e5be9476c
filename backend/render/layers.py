"""The coloured mode: Gaussian particles composited front to back, for thick smoke whose colour varies with depth.

    color_k = sum over i, nearest first, of c_ik (1 - exp(-tau_i)) exp(-sum of tau_j before i),   opacity = 1 - exp(-sum of tau_i)

tau_i is the same splat as in splat.py; opacity is the same as there. For one colour the two modes agree; for several,
splat.py gives each pixel the mean of its smoke. Particles are ordered by the depth of their centres, as in Gaussian splatting
(Kerbl 2023). Everything is drawn at full resolution. The same to the last bit for any number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from backend.geometry.camera import View

from . import projection
from .binning import bin_splats
from .gaussians import Gaussians, require_finite
from .layer_kernels import differentiate_layers, draw_layers
from .projection_gradient import Found, no_gradients, project_backward
from .pyramid import make_pyramid
from .splat import FAINTEST, Geometry, Gradients, checked_near, inputs_of, require_image
from .splat_kernels import NUM_SUMS, copy_rows, gather, scaled_into


@dataclass(frozen=True, slots=True, kw_only=True)
class Layers:
    """A picture, and what its backward pass needs. Everything but the picture and `order` is nearest first."""

    color: np.ndarray  # [K, H, W] float32, premultiplied
    opacity: np.ndarray  # [H, W] float32
    order: np.ndarray  # [N] int64: which particle stands at each place of the order
    gaussians: Gaussians
    features: np.ndarray  # [N, K] float32
    amplitudes: np.ndarray  # [N] float32
    geometry: Geometry


def forward(gaussians: Gaussians, view: View, features: np.ndarray, *, near: float | None = None) -> Layers:
    """Draws `features` [N, K], for example colours. near: depth in m before which nothing is seen (None: fits)."""
    near = checked_near(gaussians, view, near)
    require_finite("features", features, (len(gaussians), features.shape[1] if features.ndim == 2 else -1))
    depth = view.to_camera(np.asarray(gaussians.positions, np.float64))[:, 2]
    order = np.argsort(depth, kind="stable")
    nearest_first = Gaussians(
        positions=gaussians.positions[order],
        scales=gaussians.scales[order],
        rotations=gaussians.rotations[order],
        optical_masses=gaussians.optical_masses[order],
        colors=gaussians.colors[order],
    )
    colors = np.ascontiguousarray(features[order], np.float32)
    geometry = _geometry(nearest_first, view, near)
    amplitudes = np.asarray(nearest_first.optical_masses, np.float64) * geometry.splats[:, 5] * geometry.splats[:, 6]
    amplitudes = np.where(amplitudes > FAINTEST, amplitudes, 0.0).astype(np.float32)
    num_channels, p = 1 + colors.shape[1], geometry.pyramid
    buffer = np.empty(num_channels * p.offsets[-1], np.float32)
    draw_layers(buffer, p, geometry.bins, geometry.splats, geometry.boxes, amplitudes, colors, numba.get_num_threads())
    image = np.empty((num_channels, view.height, view.width), np.float32)
    copy_rows(buffer, p.strides[0], image)
    return Layers(
        color=image[1:],
        opacity=1.0 - image[0],
        order=order,
        gaussians=nearest_first,
        features=colors,
        amplitudes=amplitudes,
        geometry=geometry,
    )


def backward(layers: Layers, grad_color: np.ndarray, grad_opacity: np.ndarray) -> Gradients:
    """Gradients of a loss from those with respect to color [K, H, W] and opacity [H, W], in the order of the particles given."""
    require_image("grad_color", grad_color, layers.color.shape)
    require_image("grad_opacity", grad_opacity, layers.opacity.shape)
    owed = np.sum(grad_color * layers.color, axis=0, keepdims=True) - grad_opacity * (1.0 - layers.opacity)
    channels = np.concatenate([owed, grad_color])
    largest = float(np.abs(channels).max(initial=0.0))
    if not np.isfinite(largest):
        raise ValueError("the gradient holds NaN or infinity")
    geometry, num, num_features = layers.geometry, len(layers.order), layers.features.shape[1]
    power = float(2.0 ** -np.floor(np.log2(largest))) if largest > 0 else 0.0
    values = np.ascontiguousarray(channels, np.float32).reshape(-1)
    gradient = np.empty(len(channels) * geometry.pyramid.offsets[-1], np.float32)
    scaled_into(values, channels.shape[2], power, np.float32(FAINTEST), gradient, geometry.pyramid.strides[0])
    slots = np.empty((len(geometry.bins.pair_slots), NUM_SUMS + num_features), np.float32)
    inputs = (geometry.splats, geometry.boxes, layers.amplitudes, layers.features, numba.get_num_threads())
    differentiate_layers(gradient, geometry.pyramid, geometry.bins, *inputs, slots)
    sums = np.empty((num, NUM_SUMS + num_features))
    gather(slots, geometry.bins.slot_starts, geometry.num_chunks, sums)
    sums *= 1.0 / power if power > 0 else 0.0
    return _in_given_order(layers, _projected_back(layers, sums), sums[:, NUM_SUMS:])


def _projected_back(layers: Layers, sums: np.ndarray) -> Found:
    num, geometry, gaussians = len(layers.order), layers.geometry, layers.gaussians
    found = no_gradients(num, geometry.num_chunks)
    inputs = (*inputs_of(gaussians), np.ascontiguousarray(gaussians.optical_masses, np.float64), geometry.lens)
    project_backward(*inputs, geometry.num_chunks, geometry.splats, geometry.levels, sums, found)
    return found


def _in_given_order(layers: Layers, found: Found, features: np.ndarray) -> Gradients:
    back = np.empty_like(layers.order)
    back[layers.order] = np.arange(len(back))
    camera = found.camera.sum(axis=0)
    return Gradients(
        positions=found.positions[back],
        scales=found.scales[back],
        rotations=found.rotations[back],
        optical_masses=found.optical_masses[back],
        features=features[back],
        camera_translation=camera[:3],
        camera_rotation=camera[3:],
    )


def _geometry(gaussians: Gaussians, view: View, near: float) -> Geometry:
    """As the optical-depth mode's, on one level."""
    num = len(gaussians)
    lens = projection.make_lens(view, near)
    splats = np.empty((num, projection.SPLAT_FIELDS))
    levels, boxes = np.empty(num, np.int64), np.empty((num, 4), np.int64)
    num_chunks = max(1, min(64, num // 256))
    projection.project(*inputs_of(gaussians), lens, 1, num_chunks, splats, levels, boxes)
    pyramid = make_pyramid(view.width, view.height, 1)
    bins = bin_splats(pyramid, levels, boxes)
    return Geometry(lens=lens, splats=splats, levels=levels, boxes=boxes, pyramid=pyramid, bins=bins, num_chunks=num_chunks)
