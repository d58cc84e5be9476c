"""How fast smoke moves, roughly: over how many frames the prior should compare images, and how often it is asked."""

from __future__ import annotations

import cv2
import numpy as np

from backend.fit.region import Region

_PAIRS = 12  # of frames that are looked at
_CLEAR = 0.7  # px that smoke should move between two frames for its motion to be told
_LONGEST = 16  # frames between them
_STRIDES = 4  # at least, in a clip
STEP = 0.7  # voxels that smoke should move across the picture in a stride. Tuned on ten held-back plumes and three scenes
_MOST_STRIDES = 2  # from one frame that the prior is asked about to the next


def stride_of(region: Region) -> int:
    """Frames in which smoke moves STEP voxels; 1 where nothing moves or everything is too fast."""
    metres = _metres_a_frame(region)
    if metres <= 0.0:
        return 1
    return int(np.clip(round(STEP * region.voxel_size / metres), 1, longest_stride(region.num_frames)))


def longest_stride(num_frames: int) -> int:
    """Of a clip, in frames: some fit in, and over each of them motion can be measured."""
    return int(np.clip(num_frames // _STRIDES, 1, _LONGEST))


def gap_of(every: int, *, stride: int) -> int:
    """Frames from one that the prior is asked about to the next: as the setting says, but never more than two strides."""
    return min(every, _MOST_STRIDES * stride)


def _metres_a_frame(region: Region) -> float:
    """Median over smoke of how far it moves across the image, the camera's own motion taken out at the source's distance."""
    count, gap, pixels = region.num_frames, 1, 0.0
    while gap < count and gap <= _LONGEST:
        firsts = np.linspace(0, count - 1 - gap, _PAIRS).astype(int)
        steps = np.concatenate([_moved(region, int(first), gap) for first in firsts])
        if steps[:, 1].sum() > 0.0:
            steps = steps[np.argsort(steps[:, 0])]
            reached = np.cumsum(steps[:, 1])
            pixels = float(steps[np.searchsorted(reached, 0.5 * reached[-1]), 0]) / gap
        if pixels * gap >= _CLEAR:
            break
        gap *= 2
    view = region.pictures.views[0]
    return pixels * float(view.to_camera(region.source[None])[0, 2]) / view.fx


def _moved(region: Region, first: int, gap: int) -> np.ndarray:
    """[N, 2]: how far smoke moved in px, and how much of it there is."""
    (before, view), (after, later) = region.pictures.of(first), region.pictures.of(first + gap)
    scale = max(float(before.max(initial=0.0)), float(after.max(initial=0.0)), 1e-6)
    coded = [np.rint(255 * np.sqrt(depth / scale)).astype(np.uint8) for depth in (before, after)]
    if min(before.shape) < 16:
        return np.zeros((0, 2))
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(coded[0], coded[1], None)  # type: ignore[call-overload]
    rows, columns = np.nonzero(before > 0.05 * scale)
    pixels = np.stack([columns, rows], axis=1) + 0.5
    depth = float(view.to_camera(region.source[None])[0, 2])
    still, _ = later.project(view.unproject(pixels, np.full(len(pixels), depth)))
    moved = pixels + flow[rows, columns] - still
    return np.stack([np.linalg.norm(moved, axis=1), before[rows, columns]], axis=1)
