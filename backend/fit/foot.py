"""Where smoke rises from by its foot: the point that the rays through the lowest smoke of the pictures pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from backend.geometry.camera import View
from backend.geometry.upright import up_of

SHARPNESS = 0.0015  # of the distance: rays through the foot are not taken to miss each other by less
CONVENTION = 0.03  # of the distance: how near to the world's origin's depth smoke is taken to stand, before anything is seen

FOOT_HEIGHT = 0.05  # of the image
FOOT_FAINT = 0.02  # of the fullest row: a row with less shows no foot
FOOT_SHARE = 0.2  # of the most that the foot's rows ever show: in frames with less the source has gone out
_ROUNDS = 30  # of weights and point; each is settled long before
_STEEP = 1e-3  # sine of the angle to straight down, below which nothing is level before a camera


@dataclass(frozen=True, slots=True)
class Usual:
    """Where smoke stands before anything is seen of it: about as far away, level with the ground, as the world's origin.

    level [3]: the way ahead of the first camera, level; place [3] m; spread m: how far from there it may be, along that way.
    """

    level: np.ndarray
    place: np.ndarray
    spread: float

    @classmethod
    def of(cls, views: Sequence[View]) -> Usual:
        first, up, point = views[0], up_of(views), standing_point(views[0])
        forward = first.camera_to_world[:3, 2]
        level = forward - up * float(up @ forward)
        level = level / np.linalg.norm(level) if np.linalg.norm(level) > _STEEP else forward
        place = np.zeros(3) if forward @ first.position < 0.0 else point
        return cls(level, place, CONVENTION * float(forward @ (point - first.position)))

    def unlikely(self, points: np.ndarray) -> np.ndarray:
        """[N]: how many e-folds less likely points [N, 3] m are than that place, by Cauchy's distribution."""
        return np.log1p(np.square((points - self.place) @ self.level / self.spread))


def standing_point(view: View) -> np.ndarray:
    """[3] m: one view tells no depth; the smoke stands where the optical axis passes the world's origin."""
    forward = view.camera_to_world[:3, 2]
    distance = float(forward @ -view.position)
    if distance <= 0.0:
        distance = 10.0
    return view.position + distance * forward


def foot_point(depth_at: Callable[[int], np.ndarray], views: Sequence[View], *, most_frames: int = 64) -> np.ndarray:
    """Where the rays through the foot of the smoke most likely meet, by up to `most_frames` frames -> [3] m.

    depth_at: frame -> its optical depth [h, w].

    The foot is what the lowest rows ever show, in the frames in which they show it: a source stands still, while all that
    has left it drifts, and drift looks like depth to a camera that turns. What the rays miss one another by is taken for one
    error that all of them share. Against it stands the distance at which smoke stands before a camera that does not move,
    which the rays may well refute: both have the tails of Cauchy's distribution, and the answer is the most likely point.
    """
    frames = np.unique(np.linspace(0, len(views) - 1, most_frames).astype(int))
    in_row = np.stack([depth_at(frame).sum(axis=1, dtype=np.float64) for frame in frames])  # [F, H]
    shown = np.flatnonzero(in_row.max(axis=0) > FOOT_FAINT * in_row.max())
    if shown.size == 0:
        return standing_point(views[0])
    height = max(1, round(FOOT_HEIGHT * in_row.shape[1]))
    rows = slice(max(0, int(shown[-1]) - height + 1), int(shown[-1]) + 1)
    in_foot = in_row[:, rows].sum(axis=1)
    places, projectors = [], []
    for frame in frames[in_foot > FOOT_SHARE * in_foot.max()]:
        view, foot = views[frame], depth_at(frame)[rows].astype(np.float64)
        row, column = np.mgrid[rows, 0 : foot.shape[1]]
        pixel = np.array([(foot * column).sum(), (foot * row).sum()]) / foot.sum() + 0.5
        across = (pixel - (view.cx, view.cy)) / (view.fx, view.fy)
        ray = view.camera_to_world[:3, :3] @ np.array([*across, 1.0])
        places.append(view.position)
        projectors.append(np.eye(3) - np.outer(ray, ray) / (ray @ ray))
    return _most_likely(np.array(places), np.array(projectors), views)


def _most_likely(places: np.ndarray, projectors: np.ndarray, views: Sequence[View]) -> np.ndarray:
    """[3] m: the point that rays from `places` [F, 3] m with `projectors` [F, 3, 3] across them pass, by weights found anew
    from what is missed. Smoke is taken to stand about as far away, level with the ground, as the world's origin."""
    first, usual = views[0], Usual.of(views)
    forward, along = first.camera_to_world[:3, 2], np.outer(usual.level, usual.level)
    point = standing_point(first)
    normal = projectors.mean(axis=0)
    moment = np.einsum("fij,fj->i", projectors, places) / len(places)
    missed, moved = 0.0, 0.0  # m^2
    for _ in range(_ROUNDS):
        rays = 1.0 / ((SHARPNESS * float(forward @ (point - first.position))) ** 2 + missed)
        convention = 1.0 / (usual.spread**2 + moved)
        point = np.linalg.solve(rays * normal + convention * along, rays * moment + convention * along @ usual.place)
        missed = float(np.square(np.einsum("fij,fj->fi", projectors, point - places)).sum(axis=1).mean())
        moved = float(usual.level @ (point - usual.place)) ** 2
    return point
