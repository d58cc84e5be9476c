"""How the picture as a whole moves: tracks on the background, and the homography that lays each frame on the first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from backend.fit.series import Series
from backend.io.images import LUMINANCE, linear_to_srgb

MAX_TRACKS = 400
MIN_TRACKS = 12  # fewer tell nothing about the camera
STILL_SHARE = 0.0025  # of the longest side: a camera on a tripod in wind
_LOST_SHARE = 0.4  # of the tracks gone: take new ones
_INLIER_PX = 1.5
_MIN_CORNER = 1e-6  # smallest eigenvalue of the structure tensor, of sRGB code 0..1: about one step of 8 bits a pixel
_MAX_BLACK = 14  # of 255; on black there is nothing but the coding noise around the smoke
_SMOKE_OPACITY = 0.02  # from here on a pixel is smoke and tells nothing about the camera
_PARALLAX_SHARE = 0.0015  # of the longest side: beyond it no single homography holds the background


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageMotion:
    """Motion of the background over sampled frames.

    to_first: [n, 3, 3] pixel of the sampled frame -> pixel of the first. num_tracks: median per frame, 0 if there was
    nothing to track. displacement: the largest mean shift from the first frame, share of the longest side.
    parallax: median distance of tracks from the homography, share of the longest side.
    """

    frames: tuple[int, ...]
    to_first: np.ndarray
    num_tracks: int
    displacement: float
    parallax: float

    @property
    def is_known(self) -> bool:
        return self.num_tracks >= MIN_TRACKS

    @property
    def is_still(self) -> bool:
        """Whether the camera stands; also where nothing in the picture could tell otherwise."""
        return not self.is_known or self.displacement < STILL_SHARE

    @property
    def has_parallax(self) -> bool:
        return self.is_known and self.parallax > _PARALLAX_SHARE

    def between(self, frame: int) -> np.ndarray:
        """[3, 3] pixel of any frame -> pixel of the first, interpolated between the sampled ones."""
        position = np.interp(frame, self.frames, np.arange(len(self.frames)))
        low = int(position)
        high = min(low + 1, len(self.frames) - 1)
        return (1.0 - (position - low)) * self.to_first[low] + (position - low) * self.to_first[high]


def measure_motion(
    frames: Series[np.ndarray],  # each [h, w, >= 3] linear
    indices: Sequence[int],  # of the frames to look at, ascending
    *,
    background: Callable[[int], np.ndarray] | None = None,  # frame -> [h, w] bool, where no smoke is
    on_step: Callable[[int, int], None] | None = None,
) -> ImageMotion:
    """Tracks corners (Shi & Tomasi 1994, pyramidal Lucas-Kanade) from key frames, fits homographies by RANSAC."""
    to_first = np.tile(np.eye(3), (len(indices), 1, 1))
    counts, errors, shifts = [], [], []
    key, key_points, key_to_first = _gray(frames[indices[0]]), None, np.eye(3)
    longest = max(key.shape)
    previous, previous_index = key, indices[0]
    for step, index in enumerate(indices):
        if key_points is None:
            mask = None if background is None else background(previous_index)
            key, key_points = previous, _corners(previous, mask)
            key_to_first = to_first[max(step - 1, 0)]
            guess = key_points.copy()
        if step == 0:
            continue
        current = _gray(frames[index])
        matched = _track(key, current, key_points, guess)
        is_found = matched[1]
        if on_step is not None:
            on_step(step, len(indices) - 1)
        previous, previous_index = current, index
        if is_found.sum() < MIN_TRACKS:
            to_first[step] = to_first[step - 1]
            counts.append(int(is_found.sum()))
            key_points = None
            continue
        guess = np.where(is_found[:, None], matched[0], guess)
        homography, inliers = _fit(matched[0][is_found], key_points[is_found])
        to_first[step] = key_to_first @ homography
        to_first[step] /= to_first[step, 2, 2]
        found = matched[0][is_found]
        if not (homography == np.eye(3)).all():  # what moves before a still camera is no parallax
            errors.append(float(np.median(np.linalg.norm(_apply(homography, found) - key_points[is_found], axis=1))))
        shifts.append(float(np.median(np.linalg.norm(_apply(to_first[step], found[inliers]) - found[inliers], axis=1))))
        counts.append(int(is_found.sum()))
        if is_found.mean() < _LOST_SHARE:
            key_points = None
    return ImageMotion(
        frames=tuple(int(i) for i in indices),
        to_first=to_first,
        num_tracks=int(np.median(counts)) if counts else 0,
        displacement=max(shifts, default=0.0) / longest,
        parallax=float(np.percentile(errors, 90)) / longest if errors else 0.0,
    )


def is_background(layer: np.ndarray) -> np.ndarray:
    """[h, w] bool: at some distance from all smoke of a layer [h, w, 4]."""
    size = 2 * max(2, round(0.015 * max(layer.shape[:2]))) + 1
    return cv2.dilate((layer[..., 3] > _SMOKE_OPACITY).astype(np.uint8), np.ones((size, size), np.uint8)) == 0


def warp(image: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """`image` [h, w, C] laid into the pixels that `homography` maps its own to; NaN where it does not reach."""
    size = (image.shape[1], image.shape[0])
    return cv2.warpPerspective(
        image.astype(np.float32),
        _half_pixel(homography),
        size,
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(np.nan,) * 4,
    )


def _half_pixel(homography: np.ndarray) -> np.ndarray:
    """From this project's pixel centres at +0.5 to OpenCV's at whole numbers."""
    shift = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    return np.linalg.inv(shift) @ homography @ shift


def _gray(frame: np.ndarray) -> np.ndarray:
    """[h, w] uint8."""
    return (255.0 * np.clip(linear_to_srgb(frame[..., :3] @ LUMINANCE), 0.0, 1.0) + 0.5).astype(np.uint8)


def _corners(gray: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """[N, 2] px, pixel centres at +0.5: the best corner of each cell of a grid that has one.

    One vote a cell, so that contrasty smoke does not outvote a faint background.
    """
    quality = cv2.cornerMinEigenVal(cv2.GaussianBlur(gray, (0, 0), 0.8).astype(np.float32) / 255.0, 5)
    quality = np.where(cv2.blur(gray, (5, 5)) > _MAX_BLACK, quality, 0.0)
    if mask is not None:
        quality = np.where(mask, quality, 0.0)
    edge = 5
    quality[:edge], quality[-edge:], quality[:, :edge], quality[:, -edge:] = 0.0, 0.0, 0.0, 0.0
    cell = max(6, round((gray.size / MAX_TRACKS) ** 0.5))
    height, width = (side // cell * cell for side in gray.shape)
    cells = quality[:height, :width].reshape(height // cell, cell, width // cell, cell).transpose(0, 2, 1, 3)
    cells = cells.reshape(height // cell, width // cell, -1)
    best = cells.argmax(axis=2)
    rows, columns = np.nonzero(cells.max(axis=2) > _MIN_CORNER)
    inside = best[rows, columns]
    points = np.stack([columns * cell + inside % cell, rows * cell + inside // cell], axis=1)
    return points.astype(np.float32) + np.float32(0.5)


def _track(before: np.ndarray, after: np.ndarray, points: np.ndarray, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points [N, 2] of `before` are in `after` [N, 2], and which were found again on the way back [N] bool."""
    if len(points) == 0:
        return points, np.zeros(0, bool)
    half = np.float32(0.5)
    options = {"winSize": (15, 15), "maxLevel": 3, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    start, aim = (points - half).astype(np.float32), (guess - half).astype(np.float32)
    there, ok, _ = cv2.calcOpticalFlowPyrLK(before, after, start, aim.copy(), **options)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, start.copy(), **options)
    is_found = (ok.ravel() == 1) & (ok_back.ravel() == 1) & (np.linalg.norm(back - start, axis=1) < 0.7)
    return there + half, is_found


def _fit(points: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Homography [3, 3] points -> targets and its inliers [N] bool; the identity where about as many did not move."""
    is_still = np.linalg.norm(points - targets, axis=1) < 0.5
    if is_still.mean() > 0.5:
        return np.eye(3), is_still
    homography, mask = cv2.findHomography(points, targets, cv2.RANSAC, _INLIER_PX)
    inliers = mask.ravel() == 1
    if homography is None or not np.isfinite(homography).all() or abs(np.linalg.det(homography)) < 1e-6:
        return np.eye(3), is_still
    if is_still.sum() > 0.8 * inliers.sum():
        return np.eye(3), is_still
    return homography, inliers


def _apply(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    p = points @ homography[:, :2].T + homography[:, 2]
    return p[:, :2] / p[:, 2:]
