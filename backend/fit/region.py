"""The part of the world that the smoke of a clip fills, and the clip's optical depth at the sizes in which it is looked at."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from backend.fit.scene import Scene, optical_depth
from backend.fit.series import Series
from backend.geometry.camera import View, resized

CELLS_HIGH, CELLS_WIDE = 37.0, 22.0  # voxels that the smoke of the clip should fill at most
PIXELS_A_CELL = 1.85
FINER = 1.5  # voxels of what becomes of a proposal, to one of its own; and pixels of what that is compared with
ROUNDS = 2  # at most, in which the prior then moves the middle
_MOST_PROBES = 5  # frames that it is asked about in each
_PROBE_SHARE = 0.25  # of the frames that it is asked about afterwards
_FAINT = 0.03  # of the largest optical depth: where the smoke of a frame ends
_PULL = 0.08  # of a frame, for each that shows smoke: how strongly the middle is drawn to the source. Smoke that drifts while
# the camera goes around looks like smoke that stands elsewhere in depth: with less it misses by metres, with more, too


def num_probes(num_asked: int) -> int:
    """Frames that the prior is asked about to move the middle, in each round, before it is asked about `num_asked`."""
    return min(_MOST_PROBES, math.ceil(_PROBE_SHARE * num_asked))


@dataclass(frozen=True, slots=True, kw_only=True)
class Pictures:
    """depths [F, h, w] float32: optical depths, made small; views: of them."""

    depths: np.ndarray
    views: tuple[View, ...]

    def of(self, frame: int) -> tuple[np.ndarray, View]:
        return self.depths[frame], self.views[frame]


@dataclass(frozen=True, slots=True, kw_only=True)
class Region:
    """centre [3] m: the middle of the smoke; source [3] m; voxel_size m, of proposals; pictures: that the prior sees; fineness:
    voxels of what becomes of its proposals, to one of their own; finer: the pictures that this is compared with."""

    centre: np.ndarray
    source: np.ndarray
    voxel_size: float
    pictures: Pictures
    fineness: float
    finer: Pictures

    @property
    def num_frames(self) -> int:
        return len(self.pictures.depths)

    @property
    def finer_size(self) -> float:
        """m: of a voxel of what becomes of proposals."""
        return self.voxel_size / self.fineness

    def finely(self, shape: tuple[int, int, int]) -> tuple[int, int, int]:
        """How many of those there are along a grid of `shape` of the proposals' voxels."""
        x, y, z = (round(self.fineness * size) for size in shape)
        return x, y, z


def find_region(layers: Series[np.ndarray], scene: Scene, *, fineness: float = FINER) -> Region | None:
    """Where the smoke of all frames together is, at the distance of its source; None where no frame shows any."""
    boxes = [_box(optical_depth(layers[frame])) for frame in range(len(layers))]
    seen = [frame for frame, box in enumerate(boxes) if box is not None]
    if not seen:
        return None
    heights, widths = [], []
    pull = _PULL * len(seen)
    normal, moment = pull * np.eye(2), pull * scene.anchor[:2]
    for frame in seen:
        view, (top, bottom, left, right, middle) = scene.views[frame], boxes[frame]  # type: ignore[misc]
        distance = np.full(3, max(float(view.to_camera(scene.anchor[None])[0, 2]), 1e-6))
        corners = view.unproject(np.array([[view.cx, top], [view.cx, bottom], [middle, view.cy]]), distance)
        heights += [corners[0, 2], corners[1, 2]]
        widths.append((right - left) / view.fx * distance[0])
        across = np.array([view.camera_to_world[0, 0], view.camera_to_world[1, 0]])
        across = across / max(float(np.linalg.norm(across)), 1e-9)
        normal += np.outer(across, across)
        moment += across * (across @ corners[2, :2])
    centre = np.array([*np.linalg.solve(normal, moment), 0.5 * (min(heights) + max(heights))])
    voxel_size = max((max(heights) - min(heights)) / CELLS_HIGH, float(np.quantile(widths, 0.9)) / CELLS_WIDE)
    view = scene.views[seen[0]]
    pixel = max(float(view.to_camera(scene.anchor[None])[0, 2]), 1e-6) / view.fx
    shares = [min(1.0, fine * PIXELS_A_CELL * pixel / voxel_size) for fine in (1.0, fineness)]
    pictures = {share: _small(layers, scene.views, share=share) for share in {*shares}}
    return Region(
        centre=centre,
        source=scene.anchor,
        voxel_size=voxel_size,
        pictures=pictures[shares[0]],
        fineness=fineness,
        finer=pictures[shares[1]],
    )


def _small(layers: Series[np.ndarray], views: Sequence[View], *, share: float) -> Pictures:
    size = max(4, round(views[0].width * share)), max(4, round(views[0].height * share))
    depths = [cv2.resize(optical_depth(layers[frame]), size, interpolation=cv2.INTER_AREA) for frame in range(len(layers))]
    return Pictures(depths=np.stack(depths), views=tuple(resized(view, size) for view in views))


def _box(depth: np.ndarray) -> tuple[float, float, float, float, float] | None:
    """[H, W] -> first and last row and column of smoke, and the column of its middle, px; None without smoke."""
    largest = float(depth.max(initial=0.0))
    if largest < 0.01:
        return None
    is_smoke = depth > _FAINT * largest
    rows, columns = np.flatnonzero(is_smoke.any(axis=1)), np.flatnonzero(is_smoke.any(axis=0))
    in_column = depth.sum(axis=0, dtype=np.float64)
    middle = float((in_column * np.arange(len(in_column))).sum() / in_column.sum()) + 0.5
    return float(rows[0]), float(rows[-1]) + 1.0, float(columns[0]), float(columns[-1]) + 1.0, middle
