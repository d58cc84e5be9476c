"""A clear sky as a background that needs no frame without smoke: a smooth gradient, and the skyline that it ends at."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.interpolate import BSpline
from scipy.ndimage import convolve1d, grey_opening

from backend.fit.clean_plate import shortest_interval
from backend.io.images import linear_to_srgb

MIN_SKY_SHARE = 0.1  # of the picture; less is no sky to speak of
_FIT_SIDE = 192  # px: a gradient needs no more
_ROUNDS = 14
_KNOTS = 24  # cubic spline pieces over the height of the picture
_ACROSS = 2  # degree of the polynomial across: a sky changes with height, and little sideways
_STIFFNESS = 0.3  # of the spline, per clear pixel; continues straight where there is no clear sky
_TOLERANCE = 3.0 / 255  # sRGB code, that clear sky may differ from a smooth gradient (banding, coding blocks)
_BELT_ROUNDS = 3
_BELT_SHARE = 0.25  # of a row's pixels that must agree
_MAX_BELT = 40.0 / 255  # sRGB code: haze does not differ more from the sky above it
_MAX_STEP = 3  # rows that the skyline may rise or fall a column
_STEP_COST = 0.15  # per row
_EDGE_GAIN = 8.0
_TERRAIN_BINS = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class Sky:
    """coded: [h, w, 3] sRGB code of the clear sky, of the whole picture (meaningful above the skyline).

    is_clear: [h, w] bool, no smoke there. skyline: [w] first row of the ground. residual: sRGB code, of the clear sky.
    """

    coded: np.ndarray
    is_clear: np.ndarray
    skyline: np.ndarray
    residual: float


def fit_sky(image: np.ndarray) -> Sky | None:
    """The sky of a frame [h, w, 3] linear; None where no smooth gradient reaches down from the top.

    A smooth gradient is fitted to the clear pixels that are connected with the top, those are found anew, in turns,
    and each turn may reach a strip further down.
    """
    coded = linear_to_srgb(image).astype(np.float32)
    height, width = coded.shape[:2]
    scale = min(1.0, _FIT_SIDE / max(height, width))
    small = (max(8, round(width * scale)), max(8, round(height * scale)))
    smooth = cv2.GaussianBlur(cv2.resize(coded, small, interpolation=cv2.INTER_AREA), (0, 0), 1.0)
    coefficients = _grow(smooth)
    if coefficients is None:
        return None
    model = _gradient(height, width, coefficients)
    blurred = cv2.GaussianBlur(coded, (0, 0), max(1.0, 1.0 / scale))
    is_clear = _connected_with_top(np.abs(blurred - model).max(axis=2) < 2.0 * _TOLERANCE)
    if is_clear.mean() < MIN_SKY_SHARE:
        return None
    residual = float(np.sqrt(np.mean((coded - model)[is_clear] ** 2)))
    return Sky(coded=model, is_clear=is_clear, skyline=_without_dents(_skyline(coded, is_clear)), residual=residual)


def _grow(smooth: np.ndarray) -> np.ndarray | None:
    """Spline coefficients of the gradient that the sky of an image [h, w, 3] coded follows; None where there is none."""
    height, width = smooth.shape[:2]
    is_clear = np.zeros((height, width), bool)
    is_clear[: max(2, height // 8)] = True
    is_clear &= _is_smooth(smooth)
    coefficients = np.zeros(0)
    for step in range(_ROUNDS):
        if is_clear.mean() < 0.02:
            return None
        lowest = int(np.flatnonzero(is_clear.any(axis=1)).max())
        coefficients = _fit(smooth, is_clear)
        tolerance = _TOLERANCE * (2.0 if step < _ROUNDS - 2 else 1.5)
        is_near = np.abs(smooth - _gradient(height, width, coefficients)).max(axis=2) < tolerance
        is_near &= np.arange(height)[:, None] < lowest + max(2, height // 20)
        is_clear = _connected_with_top(is_near)
    if is_clear.mean() < MIN_SKY_SHARE:
        return None
    line = _skyline(smooth, is_clear)
    for _ in range(_BELT_ROUNDS):
        is_clear = _with_haze_belt(smooth, _gradient(height, width, coefficients), is_clear, line)
        coefficients = _fit(smooth, is_clear)
    return coefficients


def _with_haze_belt(smooth: np.ndarray, model: np.ndarray, is_clear: np.ndarray, line: np.ndarray) -> np.ndarray:
    """[h, w] bool: the clear pixels, and of the rows between them and the skyline those that agree along their row.

    Close above the horizon haze bends the gradient faster than the turns before could follow, but it bends it alike
    over the width of the picture; smoke does not. A row's own value is the one that most of its pixels share.
    """
    height, width = is_clear.shape
    is_above = np.arange(height)[:, None] < line - 1
    num_above = is_above.sum(axis=1)
    is_covered = (is_clear.sum(axis=1) >= 0.5 * num_above) & (num_above > 0)
    if not is_covered.any():
        return is_clear
    is_belt = (np.arange(height) > np.flatnonzero(is_covered).max())[:, None] & is_above
    difference = np.where(is_belt[..., None], smooth - model, np.nan)
    length = max(4, round(_BELT_SHARE * width))
    centre, spread = shortest_interval(difference.transpose(1, 0, 2), length)
    is_row = (spread.max(axis=1) < 4.0 * _TOLERANCE) & (np.abs(centre).max(axis=1) < _MAX_BELT)
    is_near = np.abs(difference - centre[:, None, :]).max(axis=2) < 2.0 * _TOLERANCE
    return (is_clear & ~is_belt) | (is_near & is_row[:, None])


def _bases(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Cubic B-splines over the rows [h, K] and Chebyshev polynomials over the columns [w, A]."""
    knots = np.linspace(-3.0, _KNOTS + 3.0, _KNOTS + 7)
    rows = _KNOTS * (np.arange(height) + 0.5) / height
    down = BSpline.design_matrix(rows, knots, 3).toarray()
    return down, np.polynomial.chebyshev.chebvander(2.0 * (np.arange(width) + 0.5) / width - 1.0, _ACROSS)


def _gradient(height: int, width: int, coefficients: np.ndarray) -> np.ndarray:
    """The sky [h, w, 3] coded that coefficients [K, A, 3] stand for, at any size."""
    down, across = _bases(height, width)
    return np.einsum("hi,wa,iac->hwc", down, across, coefficients, optimize=True).astype(np.float32)


def _fit(coded: np.ndarray, is_clear: np.ndarray) -> np.ndarray:
    """Penalised spline (Eilers & Marx 1996) through the clear pixels of [h, w, 3]; coefficients [K, A, 3].

    Second differences of the spline's coefficients are held small, so it goes on straight beyond the clear sky.
    """
    down, across = _bases(*coded.shape[:2])
    weight = is_clear.astype(np.float64)
    num_down, num_across = down.shape[1], across.shape[1]
    products = (across[:, :, None] * across[:, None, :]).reshape(len(across), -1)  # [w, A A]
    moments = weight @ products  # [h, A A]
    pairs = (down[:, :, None] * down[:, None, :]).reshape(len(down), -1)  # [h, K K]
    normal = (pairs.T @ moments).reshape(num_down, num_down, num_across, num_across)
    normal = normal.transpose(0, 2, 1, 3).reshape(num_down * num_across, -1)
    right = np.einsum("hi,wa,hwc->iac", down, across, weight[..., None] * coded, optimize=True).reshape(len(normal), 3)
    bend = np.diff(np.eye(num_down), n=2, axis=0)
    stiffness = np.kron(bend.T @ bend, np.diag([1.0, 10.0, 100.0][:num_across]))
    normal = normal + weight.sum() / num_down * (_STIFFNESS * stiffness + 1e-6 * np.eye(len(normal)))
    return np.linalg.solve(normal, right).reshape(num_down, num_across, 3)


def _is_smooth(coded: np.ndarray) -> np.ndarray:
    gradient = np.abs(cv2.Sobel(coded, cv2.CV_32F, 1, 0)) + np.abs(cv2.Sobel(coded, cv2.CV_32F, 0, 1))
    return gradient.max(axis=2) / 8.0 < 6.0 / 255


def _connected_with_top(is_near: np.ndarray) -> np.ndarray:
    """The pixels of a mask that touch, through each other, one of the top rows."""
    _, labels = cv2.connectedComponents(is_near.astype(np.uint8), connectivity=4)
    touching = np.unique(labels[: max(2, is_near.shape[0] // 50)])
    return is_near & np.isin(labels, touching[touching > 0])


def _skyline(coded: np.ndarray, is_clear: np.ndarray) -> np.ndarray:
    """[w] first row of the ground: the cheapest path from left to right (dynamic programming).

    Above it pixels should be clear sky or a mixture of sky and grey; below it they should look like the ground, whose
    colours and texture are learned from the rows below the lowest clear sky; on it there should be an edge.
    """
    width = coded.shape[1]
    ground = _ground_likeness(coded, is_clear)
    above = np.where(is_clear, 0.0, ground)
    below = np.where(is_clear, 2.0, 1.0 - ground)
    total_above = np.concatenate([np.zeros((1, width)), np.cumsum(above, axis=0)])
    total_below = np.concatenate([np.cumsum(below[::-1], axis=0)[::-1], np.zeros((1, width))])
    edge = np.abs(cv2.Sobel(coded, cv2.CV_32F, 0, 1, ksize=3)).max(axis=2) / 8.0
    edge = np.concatenate([edge, np.zeros((1, width), np.float32)])
    cost = total_above + total_below - _EDGE_GAIN * np.minimum(edge, 0.1) / 0.1
    return _cheapest_path(cost)


def _ground_likeness(coded: np.ndarray, is_clear: np.ndarray) -> np.ndarray:
    """[h, w] 0..1: how much a pixel looks like the ground rather than like what hangs in the sky.

    Two histograms of colour and local texture: of the rows surely on the ground, and of the sky with what is in it.
    """
    height, _ = is_clear.shape
    clear_rows = np.flatnonzero(np.asarray(is_clear.mean(axis=1)) > 0.05)
    lowest = int(clear_rows.max()) + 1
    ground_from = min(height - 2, lowest + max(2, height // 50))
    luma = coded.mean(axis=2)
    detail = np.sqrt(np.maximum(cv2.GaussianBlur(luma**2, (0, 0), 1.5) - cv2.GaussianBlur(luma, (0, 0), 1.5) ** 2, 0.0))
    features = np.stack(
        [luma, 0.5 + 2.0 * (coded[..., 0] - coded[..., 2]), 0.5 + 3.0 * (coded[..., 1] - luma), np.minimum(10.0 * detail, 1.0)],
        axis=2,
    )
    bins = np.clip((features * _TERRAIN_BINS).astype(int), 0, _TERRAIN_BINS - 1)
    shape = (_TERRAIN_BINS,) * 4
    flat = np.asarray(np.ravel_multi_index(tuple(np.moveaxis(bins, 2, 0)), shape))

    def histogram(pixels: np.ndarray) -> np.ndarray:
        counts = np.bincount(pixels.ravel(), minlength=_TERRAIN_BINS**4).reshape(shape).astype(np.float32)
        for axis in range(4):
            counts = convolve1d(counts, [0.25, 0.5, 0.25], axis=axis, mode="constant")
        return counts.ravel() / max(counts.sum(), 1.0) + 1e-5

    ground = histogram(flat[ground_from:])
    sky = histogram(flat[: max(2, int(0.9 * lowest))])
    return cv2.GaussianBlur((ground / (ground + sky))[flat].astype(np.float32), (0, 0), 0.7)


def _without_dents(line: np.ndarray) -> np.ndarray:
    """[w] the skyline without dips narrower than a sixteenth of the width: bright fields below the horizon make such."""
    return grey_opening(line, size=2 * (len(line) // 32) + 1, mode="nearest")


def _cheapest_path(cost: np.ndarray) -> np.ndarray:
    """[w] row of the path through cost [h + 1, w] that is cheapest, with a price on every step up or down."""
    rows, width = cost.shape
    steps = np.arange(-_MAX_STEP, _MAX_STEP + 1)
    total = cost[:, 0].copy()
    came = np.zeros((rows, width), np.int8)
    for column in range(1, width):
        padded = np.pad(total, _MAX_STEP, constant_values=np.inf)
        options = np.stack([padded[_MAX_STEP + s : _MAX_STEP + s + rows] + _STEP_COST * abs(s) for s in steps])
        best = np.asarray(options.argmin(axis=0))
        came[:, column] = steps[best]
        total = options[best, np.arange(rows)] + cost[:, column]
    path = np.empty(width, np.int64)
    path[-1] = total.argmin()
    for column in range(width - 1, 0, -1):
        path[column - 1] = path[column] + came[path[column], column]
    return path
