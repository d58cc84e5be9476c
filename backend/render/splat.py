"""Optical depth of Gaussian particles as an image, with its gradient: the renderer that the fit uses (CPU, numba).

    image[0]     = tau = sum over i of m_i G_i(pixel)          optical depth
    image[1 + k] = sum over i of m_i G_i(pixel) c_ik           features, for example colours

G_i is the splat of projection.py with integral 1, m_i the projected optical mass in px^2. Sums need no sorting: for one
colour of smoke tau is exact. Differs from the direct sum (torch_twin.py) by less than 1e-5 of the largest tau: splats end
where they are exp(-12.5) of their peak, and smooth ones are drawn on coarser levels (pyramid.py). Results are the same to
the last bit for any number of threads. Call from one Python thread at a time: numba's own thread pool does the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from backend.geometry.camera import View

from . import projection
from .binning import Bins, bin_splats
from .composite import composite, composite_backward
from .gaussians import Gaussians, require_finite
from .projection_gradient import no_gradients, project_backward
from .pyramid import Pyramid, make_pyramid, max_levels, upsample, upsample_adjoint
from .splat_kernels import NUM_SUMS, copy_rows, differentiate, draw, gather, largest_magnitude, scaled_into, weigh

__all__ = ["Gradients", "Splat", "adjoint_mass", "backward", "composite", "composite_backward", "forward", "reweighted"]

FAINTEST = 1e-20  # amplitudes (optical depth) and relative gradients below this are zero: their products would be denormal


@dataclass(frozen=True, slots=True, kw_only=True)
class Geometry:
    """Everything that depends on positions, scales, rotations and view, but not on masses or features."""

    lens: projection.Lens
    splats: np.ndarray  # [N, SPLAT_FIELDS]
    levels: np.ndarray  # [N] -1: not visible
    boxes: np.ndarray  # [N, 4] cells that a splat may touch: first and last row, first and last column
    pyramid: Pyramid
    bins: Bins
    num_chunks: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Splat:
    """An image, and what its backward pass needs."""

    image: np.ndarray  # [1 + K, H, W] float32
    gaussians: Gaussians
    view: View
    features: np.ndarray  # [N, K] float32
    optical_masses: np.ndarray  # [N] float64 m^2
    geometry: Geometry


@dataclass(frozen=True, slots=True, kw_only=True)
class Gradients:
    """Of a scalar loss. The camera moves in its own axes: p_camera becomes p_camera - translation - rotation x p_camera."""

    positions: np.ndarray  # [N, 3] float64
    scales: np.ndarray  # [N, 3] float64
    rotations: np.ndarray  # [N, 4] float64, tangent to the unit sphere
    optical_masses: np.ndarray  # [N] float64
    features: np.ndarray  # [N, K] float64
    camera_translation: np.ndarray  # [3] float64, 1/m
    camera_rotation: np.ndarray  # [3] float64, 1/radian


def forward(gaussians: Gaussians, view: View, *, features: np.ndarray | None = None, near: float | None = None) -> Splat:
    """Draws the optical depth and `features` [N, K] (None: K = 0). near: depth in m before which nothing is seen (None: fits)."""
    near = checked_near(gaussians, view, near)
    geometry = _geometry(gaussians, view, near)
    return _drawn(gaussians, view, geometry, gaussians.optical_masses, features)


def reweighted(splat: Splat, optical_masses: np.ndarray, features: np.ndarray | None = None) -> Splat:
    """The same geometry with other masses [N] m^2 and features [N, K]: no projection, no binning."""
    require_finite("optical_masses", optical_masses, (len(splat.gaussians),))
    if len(optical_masses) and np.min(optical_masses) < 0:
        raise ValueError("optical_masses holds negative numbers")
    return _drawn(splat.gaussians, splat.view, splat.geometry, optical_masses, features)


def backward(splat: Splat, grad_image: np.ndarray) -> Gradients:
    """Gradients of a loss whose gradient with respect to splat.image is grad_image [1 + K, H, W]."""
    require_image("grad_image", grad_image, splat.image.shape)
    geometry, bins, num = splat.geometry, splat.geometry.bins, len(splat.gaussians)
    num_features = splat.features.shape[1]
    gradient, scale = _gradient_levels("grad_image", grad_image, geometry.pyramid)
    slots = np.empty((len(bins.pair_slots), NUM_SUMS + num_features), np.float32)
    differentiate(
        gradient, geometry.pyramid, bins, geometry.splats, geometry.boxes, splat.features, numba.get_num_threads(), slots
    )
    sums = np.empty((num, NUM_SUMS + num_features))
    gather(slots, bins.slot_starts, geometry.num_chunks, sums)
    sums *= scale
    amplitudes = splat.optical_masses * geometry.splats[:, 5] * geometry.splats[:, 6]
    found = no_gradients(num, geometry.num_chunks)
    inputs = (*inputs_of(splat.gaussians), splat.optical_masses, geometry.lens, geometry.num_chunks)
    project_backward(*inputs, geometry.splats, geometry.levels, sums, found)
    camera = found.camera.sum(axis=0)
    return Gradients(
        positions=found.positions,
        scales=found.scales,
        rotations=found.rotations,
        optical_masses=found.optical_masses,
        features=amplitudes[:, None] * sums[:, NUM_SUMS:],
        camera_translation=camera[:3],
        camera_rotation=camera[3:],
    )


def adjoint_mass(splat: Splat, image_grad: np.ndarray) -> np.ndarray:
    """Transpose of masses -> tau: [N] sums over pixels of image_grad [H, W] times d tau / d optical_mass [1/m^2]."""
    require_image("image_grad", image_grad, splat.image.shape[1:])
    geometry, bins = splat.geometry, splat.geometry.bins
    gradient, scale = _gradient_levels("image_grad", image_grad[None], geometry.pyramid)
    slots = np.empty((len(bins.pair_slots), 1), np.float32)
    weigh(gradient, geometry.pyramid, bins, geometry.splats, geometry.boxes, numba.get_num_threads(), slots.reshape(-1))
    sums = np.empty((len(splat.gaussians), 1))
    gather(slots, bins.slot_starts, geometry.num_chunks, sums)
    return sums[:, 0] * geometry.splats[:, 5] * geometry.splats[:, 6] * scale


def checked_near(gaussians: Gaussians, view: View, near: float | None) -> float:
    """`near`, or what fits the scene. Raises ValueError where it or the view is no camera's."""
    check_view(view, projection.NEAR if near is None else near)
    return projection.near_plane(np.asarray(gaussians.positions, np.float64), view) if near is None else near


def check_view(view: View, near: float) -> None:
    require_finite("camera_to_world", np.asarray(view.camera_to_world), (4, 4))
    numbers = np.array([view.width, view.height, view.fx, view.fy, view.cx, view.cy, near], np.float64)
    if not np.isfinite(numbers).all() or numbers[:4].min() <= 0 or near <= 0:
        raise ValueError(f"{view.width} x {view.height} px, fx {view.fx}, fy {view.fy}, near {near} m is no camera")


def require_image(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype.kind != "f":
        raise ValueError(f"{name} is {getattr(array, 'dtype', type(array))} {getattr(array, 'shape', '')}, not float {shape}")


def inputs_of(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, scales and rotations as the kernels take them."""
    arrays = (gaussians.positions, gaussians.scales, gaussians.rotations)
    return tuple(np.ascontiguousarray(array, np.float64) for array in arrays)  # type: ignore[return-value]


def _geometry(gaussians: Gaussians, view: View, near: float) -> Geometry:
    num = len(gaussians)
    lens = projection.make_lens(view, near)
    splats = np.empty((num, projection.SPLAT_FIELDS))
    levels = np.empty(num, np.int64)
    boxes = np.empty((num, 4), np.int64)
    num_chunks = max(1, min(64, num // 256))
    projection.project(*inputs_of(gaussians), lens, max_levels(view.width, view.height), num_chunks, splats, levels, boxes)
    pyramid = make_pyramid(view.width, view.height, 1 + max(0, int(levels.max(initial=0))))
    bins = bin_splats(pyramid, levels, boxes)
    return Geometry(
        lens=lens,
        splats=splats,
        levels=levels,
        boxes=boxes,
        pyramid=pyramid,
        bins=bins,
        num_chunks=num_chunks,
    )


def _drawn(
    gaussians: Gaussians, view: View, geometry: Geometry, optical_masses: np.ndarray, features: np.ndarray | None
) -> Splat:
    num, p, bins = len(gaussians), geometry.pyramid, geometry.bins
    if features is None:
        features = np.empty((num, 0), np.float32)
    if features.ndim != 2:
        raise ValueError(f"features has shape {features.shape}, not ({num}, K)")
    require_finite("features", features, (num, features.shape[1]))
    masses = np.asarray(optical_masses, np.float64)
    colors = np.ascontiguousarray(features, np.float32)
    amplitudes = masses * geometry.splats[:, 5] * geometry.splats[:, 6]
    amplitudes = np.where(amplitudes > FAINTEST, amplitudes, 0.0).astype(np.float32)
    num_channels = 1 + colors.shape[1]
    buffer = np.empty(num_channels * p.offsets[-1], np.float32)
    draw(buffer, p, bins, geometry.splats, geometry.boxes, amplitudes, colors, numba.get_num_threads())
    upsample(buffer, p, num_channels)
    image = np.empty((num_channels, view.height, view.width), np.float32)
    copy_rows(buffer, p.strides[0], image)
    return Splat(image=image, gaussians=gaussians, view=view, features=colors, optical_masses=masses, geometry=geometry)


def _gradient_levels(name: str, grad_image: np.ndarray, pyramid: Pyramid) -> tuple[np.ndarray, float]:
    """The gradient [C, H, W] on all levels, flat, divided by its largest magnitude, and that magnitude."""
    values = np.ascontiguousarray(grad_image, np.float32).reshape(-1)
    per_chunk = np.empty(64, np.float32)
    largest_magnitude(values, per_chunk)
    scale = float(np.max(per_chunk))  # NaN if there is any
    if not np.isfinite(scale):
        raise ValueError(f"{name} holds NaN or infinity")
    buffer = np.empty(len(grad_image) * pyramid.offsets[-1], np.float32)
    # In two steps, because 1 / scale may lie beyond float32.
    power = float(2.0 ** -np.floor(np.log2(scale))) if scale > 0 else 0.0
    scaled_into(values, grad_image.shape[2], power, np.float32(FAINTEST), buffer, pyramid.strides[0])
    upsample_adjoint(buffer, pyramid, len(grad_image))
    return buffer, (1.0 / power if scale > 0 else 0.0)
