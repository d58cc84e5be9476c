"""Where smoke rises from, told by a camera that goes around it.

A source stands still, and at it smoke is fresh: dense and narrow. All that has left it drifts, spreads and thins. So a source is
the point that stands out from what is around it in the mean over the frames, wherever the camera was. The foot of the smoke in
the picture says roughly how far away that is; but what wind carries towards the camera sinks below the source in the picture,
and so the foot is not asked for more, but where its word is all there is: of a short clip behind the end of a source.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from backend.fit.foot import Usual, foot_point
from backend.geometry.camera import View, resized
from backend.geometry.upright import up_of

_EXTENT = 128.0  # px that smoke is made as large as, at most
_FAINT = 0.03  # of the largest optical depth: where smoke ends
_LIT = 0.2  # of the largest optical depth: frames with less show too little
_NARROW, _WIDE = 1 / 128, 6 / 128  # of the smoke's extent: standard deviations of what stands out and of what is around it
_STARTS = 3  # frames whose pixels are followed into depth
_PIXELS = 200  # of each, those that stand out most, of one pixel in four
_NEAR, _FAR, _DEPTHS = 0.6, 1.67, 72  # of the distance of the foot
_SOURCES = 8  # at most
_NEARLY = 0.8  # of what stands out most: what does as much is another source
_APART = 12 / 128  # of the smoke's extent: sources that are nearer are one
_HALF = 0.5  # of the smoke at a source: the foot is where there is less below it
_TOO_HIGH = 0.1  # of the distance, above the foot of all smoke: what stands out there has left a source that is out
_CLIMBS = 9
_ALONG, _STEPS = 0.2, 81  # of the distance, along the view to either side, and places there, among which it may lie in depth
_SURELY = 0.012  # of a frame's largest optical depth, that e-folds less likely places stand out less; tuned on 20 plumes
_KNOWN = 0.01  # of the distance: depth that is known as well is where smoke stands out most
_DOWN = 0.1  # of the distance, that it is looked for below
_ROW = 1024  # points looked up in a row: OpenCV's pictures are not longer than 32767
_AGAINST = 0.01  # of a frame's largest optical depth, for each e-fold that a place is unlikely by that; tuned on 134 plumes


def source_point(depth_at: Callable[[int], np.ndarray], views: Sequence[View], *, most_frames: int = 24) -> np.ndarray:
    """Where the smoke rises from, by up to `most_frames` frames -> [3] m: the middle of its sources.

    depth_at: frame -> its optical depth [h, w].

    Of many points before the camera the one is found that stands out most (a difference of Gaussians, Marr and Hildreth 1980,
    in the mean over frames), and others that stand out nearly as much. Against a point counts how far it is from where smoke
    stands before a camera that does not move, which decides where the camera hardly turns. What a short clip leaves open of its
    depth is answered by the mean. Where nothing stands out, or what does is far above the foot of all smoke, it is that foot.
    """
    frames = np.unique(np.linspace(0, len(views) - 1, most_frames).astype(int))
    views = [views[frame] for frame in frames]
    depths = [np.ascontiguousarray(depth_at(int(frame)), np.float32) for frame in frames]
    rough = foot_point(depths.__getitem__, views, most_frames=len(views))
    seen = _looked(depths, views)
    if seen is None:
        return rough
    usual = Usual.of(views)
    starts = np.concatenate(
        [
            _before(seen.out[index], seen.views[index], distance=float(seen.views[index].to_camera(rough[None])[0, 2]))
            for index in sorted({*np.linspace(0, len(seen.views) - 1, 2 * _STARTS + 1).round().astype(int)[1::2].tolist()})
        ]
    )
    found, weights = [], []
    values = seen.standing_out(starts, usual)
    apart = _APART * seen.extent / seen.views[0].fx * float(np.linalg.norm(rough - views[0].position))
    free, least = np.ones(len(starts), bool), _NEARLY * values.max()
    for _ in range(_SOURCES):
        best = int(np.where(free, values, -np.inf).argmax())
        if not free[best] or values[best] < max(least, 0.0):
            break
        point, value = _climbed(starts[best], seen, usual)
        point = _expected(point, seen, usual)
        if all(np.linalg.norm(point - other) > apart for other in found):
            found.append(point)
            weights.append(value)
        free &= (np.linalg.norm(starts - starts[best], axis=1) > apart) & (np.linalg.norm(starts - point, axis=1) > apart)
    if not found or max(weights) <= 0.0:
        return rough
    most = np.array(weights) > _NEARLY * max(weights)
    up = up_of(views)
    feet = [seen.foot(point, up) for point, is_one in zip(found, most, strict=True) if is_one]
    middle = np.average(feet, axis=0, weights=np.array(weights)[most])
    is_smoke_that_left = (middle - rough) @ up > _TOO_HIGH * np.linalg.norm(rough - views[0].position)
    return rough if is_smoke_that_left else middle


@dataclass(frozen=True, slots=True)
class _Looked:
    """Frames that show smoke, made small: optical depth as a share of the frame's largest [h, w], how much of that stands out,
    the views; and how many px the smoke is large."""

    shares: list[np.ndarray]
    out: list[np.ndarray]
    views: list[View]
    extent: float

    def standing_out(self, points: np.ndarray, usual: Usual) -> np.ndarray:
        """[N]: of points [N, 3] m."""
        return _mean(self.out, self.views, points) - _AGAINST * usual.unlikely(points)

    def foot(self, point: np.ndarray, up: np.ndarray) -> np.ndarray:
        """[3] m: straight below, where there is half of the smoke."""
        down = np.linspace(0.0, _DOWN, 41) * np.linalg.norm(point - self.views[0].position)
        below = point - down[:, None] * up
        shares = _mean(self.shares, self.views, below)
        thin = np.flatnonzero(shares < _HALF * shares[0])
        return below[thin[0]] if thin.size else point


def _looked(depths: Sequence[np.ndarray], views: Sequence[View]) -> _Looked | None:
    """None where no frame shows smoke."""
    most = np.array([float(depth.max(initial=0.0)) for depth in depths])
    if not most.max() > 0.0:
        return None
    lit = np.flatnonzero(most > _LIT * most.max()).tolist()
    shown = np.max([depths[index] for index in lit], axis=0) > _FAINT * most.max()
    spans = [np.flatnonzero(shown.any(axis=axis)) for axis in (0, 1)]
    extent = float(max(span[-1] - span[0] + 1 for span in spans))
    share = min(1.0, _EXTENT / extent)
    size = max(4, round(shown.shape[1] * share)), max(4, round(shown.shape[0] * share))
    shares = [cv2.resize(depths[index], size, interpolation=cv2.INTER_AREA) for index in lit]
    shares = [np.asarray(depth / max(float(depth.max()), 1e-6), np.float32) for depth in shares]
    narrow, wide = (spread * share * extent for spread in (_NARROW, _WIDE))
    out = [cv2.GaussianBlur(depth, (0, 0), narrow) - cv2.GaussianBlur(depth, (0, 0), wide) for depth in shares]
    return _Looked(shares, out, [resized(views[index], size) for index in lit], share * extent)


def _before(out: np.ndarray, view: View, *, distance: float) -> np.ndarray:
    """[N, 3] m: along the rays of the pixels that stand out most."""
    row, column = np.unravel_index(np.argsort(-out[::2, ::2], axis=None, kind="stable")[:_PIXELS], out[::2, ::2].shape)
    pixels = 2.0 * np.stack([column, row], axis=1) + 0.5
    depths = max(distance, 1e-6) * np.geomspace(_NEAR, _FAR, _DEPTHS)
    return view.unproject(np.tile(pixels, (len(depths), 1)), np.repeat(depths, len(pixels)))


def _climbed(point: np.ndarray, seen: _Looked, usual: Usual) -> tuple[np.ndarray, float]:
    """The point near a first guess that stands out most, and how much."""
    step, value = 0.01 * float(np.linalg.norm(point - seen.views[0].position)), 0.0
    around = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    around = around @ seen.views[0].rotation_world_to_camera  # along its axes: a world that is turned gets the same answer
    for _ in range(_CLIMBS):
        values = seen.standing_out(point + step * around, usual)
        best = int(values.argmax())
        point, value = point + step * around[best], float(values[best])
        step *= 0.5 if best == len(around) // 2 else 0.75
    return point, value


def _expected(point: np.ndarray, seen: _Looked, usual: Usual) -> np.ndarray:
    """The mean of the places along the view through a point that stand out nearly as much: which of them does most is chance
    where the camera hardly turns."""
    view = seen.views[len(seen.views) // 2]
    places = point + np.linspace(-_ALONG, _ALONG, _STEPS)[:, None] * (point - view.position)
    values = seen.standing_out(places, usual)
    likely = np.exp((values - values.max()) / _SURELY)
    mean = likely @ places / likely.sum()
    spread = math.sqrt(likely @ np.square(places - mean).sum(axis=1) / likely.sum())
    return mean if spread > _KNOWN * np.linalg.norm(point - view.position) else point


def _mean(images: Sequence[np.ndarray], views: Sequence[View], points: np.ndarray) -> np.ndarray:
    """[N]: mean of what images show of points [N, 3] m; nothing beside a picture."""
    shape = -(-len(points) // _ROW), _ROW
    total = np.zeros(len(points))
    for image, view in zip(images, views, strict=True):
        pixels, distances = view.project(points)
        column, row = (np.resize(pixels[:, axis] - 0.5, shape).astype(np.float32) for axis in (0, 1))
        found = cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
        total += np.where(distances > 0.0, found.ravel()[: len(points)], 0.0)
    return total / len(images)
