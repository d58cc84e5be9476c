"""The mean motion of the smoke on each ray, as neighbouring pictures tell it.

Optical depth is what all smoke on a ray adds up to, and where smoke is neither born nor dies its change is the divergence of what
flows across the view:

    d tau / dt + div (tau u) = 0,    u: mean of the velocity along the ray, by density

A proposal's own u leaves a residual. The smallest smooth change of u that explains it (least squares, a Gaussian process a voxel
wide) is added to all velocities of the ray: which part of the smoke along it moves otherwise is not known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage
from scipy.sparse.linalg import LinearOperator, lsqr

from backend.fit.guide import Guide
from backend.geometry.camera import View

_CELLS = 3  # in a voxel, at most: then smoke crosses about one in a frame
_WIDTH = 1.0  # voxels, standard deviation of the smoothing of changes
_TIGHTNESS = 0.25  # error of the residual over that of the velocity, in cells and frames; tuned on the three scenes
_FAINT = 0.1  # of the largest optical depth, added where residuals are weighed
_BLUR = 0.4  # cells, standard deviation, of the pictures
_EDGE = 3.0  # px at a picture's border that are not looked at
_ITERATIONS = 40


def followed(guide: Guide, depths: Sequence[np.ndarray], views: Sequence[View], middle: int, *, seconds: float) -> np.ndarray:
    """Velocities [X, Y, Z, 3] m/s of a proposal, changed to what the pictures of frames beside its own show.

    depths: optical depths [H, W] of up to three neighbouring frames, `seconds` apart; views: of that size; middle: which of them
    is the proposal's. A frame alone tells nothing, and smoke that crosses more than a voxel in one keeps its velocities.
    """
    own = guide.velocity @ guide.stand.from_world[:3, :3].T
    across = own[..., [0, 2]].astype(np.float64)
    density = guide.density.astype(np.float64)
    mass = density.sum(axis=1)
    if len(depths) < 2 or not mass.any():
        return guide.velocity
    voxel = guide.lattice.voxel_size
    speed = float(np.sqrt(np.average(np.square(across).sum(axis=-1), weights=density)))
    cells = int(np.clip(voxel / max(speed * seconds, 1e-300), 0.0, _CELLS))
    if cells == 0:
        return guide.velocity
    known = mass > 0.0
    mean = (across * density[..., None]).sum(axis=1) / np.where(known, mass, 1.0)[..., None]  # [X, Z, 2]
    mean = np.where(known[..., None], mean, across.mean(axis=1))
    sheet = _Sheet(guide, cells)
    tau, change, seen = sheet.look(depths, views, middle)
    if not tau.any():
        return guide.velocity
    unit = voxel / cells / seconds  # m/s: a cell a frame
    found = unit * _explained(tau / tau.max(), change / tau.max(), sheet.fine(mean) / unit, seen, width=_WIDTH * cells)
    more = np.zeros((*mass.shape, 3))
    more[..., [0, 2]] = found[::cells, ::cells]
    return (guide.velocity + (more @ guide.stand.from_world[:3, :3])[:, None]).astype(np.float32)


class _Sheet:
    """The upright sheet through the middle of a proposal's smoke, some cells to a voxel, and its pictures: a point that stands
    still is at the same place in all of them."""

    def __init__(self, guide: Guide, cells: int) -> None:
        shape = guide.density.shape
        at = [np.arange(cells * (shape[axis] - 1) + 1) / cells for axis in (0, 2)]
        self.places = np.stack(np.meshgrid(*at, indexing="ij"))  # [2, X', Z'] voxels
        mass = guide.density.sum(axis=1, dtype=np.float64)
        deep = np.einsum("xyz,y->xz", guide.density.astype(np.float64), np.arange(shape[1]))
        whole = float(deep.sum() / mass.sum())
        little = 1e-3 * float(mass.max())
        middle = ndimage.gaussian_filter((deep + little * whole) / (mass + little), 1.0)
        voxels = np.stack([self.places[0], self.fine(middle), self.places[1]], axis=-1)
        local = voxels * guide.lattice.voxel_size + np.array(guide.lattice.origin)
        from_world = guide.stand.from_world
        self.points = ((local - from_world[:3, 3]) @ from_world[:3, :3]).reshape(-1, 3)
        self.cell = guide.lattice.voxel_size / cells

    def fine(self, values: np.ndarray) -> np.ndarray:
        """Values [X, Z, ..] of the voxels at the cells."""
        if values.ndim == 2:
            return ndimage.map_coordinates(values, self.places, order=1, mode="nearest")
        return np.stack([self.fine(values[..., index]) for index in range(values.shape[2])], axis=-1)

    def look(self, depths: Sequence[np.ndarray], views: Sequence[View], middle: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """[X', Z'] each: optical depth, its change in a frame, and whether all frames show it."""
        found, seen = [], np.ones(self.places.shape[1:], bool)
        for depth, view in zip(depths, views, strict=True):
            pixels, away = view.project(self.points)
            edge = np.array([view.width, view.height]) - _EDGE
            inside = (away > 0) & (pixels > _EDGE).all(axis=1) & (pixels < edge).all(axis=1)
            size = view.fx * self.cell / float(np.median(away[inside])) if inside.any() else 0.0  # px
            blurred = ndimage.gaussian_filter(depth.astype(np.float64), _BLUR * size, mode="nearest")
            rows, columns = np.where(inside[:, None], pixels - 0.5, 0.0).T[::-1]
            found.append(ndimage.map_coordinates(blurred, [rows, columns], order=1).reshape(seen.shape))
            seen &= inside.reshape(seen.shape)
        seen = ndimage.binary_erosion(seen, np.ones((5, 5)))
        return found[middle], (found[-1] - found[0]) / (len(found) - 1), seen


def _explained(tau: np.ndarray, change: np.ndarray, mean: np.ndarray, seen: np.ndarray, *, width: float) -> np.ndarray:
    """[X', Z', 2] cells a frame: what has to be added to `mean` [X', Z', 2] for the change [X', Z'] of optical depths
    tau [X', Z'], of which the largest is 1. width: cells."""
    weight = seen / np.sqrt(tau + _FAINT)
    residual = change + _slope(tau * mean[..., 0], 0) + _slope(tau * mean[..., 1], 1)
    size, half = np.sqrt(4.0 * np.pi) * width, tau.size  # size: smoothed noise is as strong as before

    def smooth(values: np.ndarray) -> np.ndarray:
        return size * ndimage.gaussian_filter(values, width, mode="constant")

    def forwards(vector: np.ndarray) -> np.ndarray:
        flows = [tau * smooth(part) for part in vector.reshape(2, *tau.shape)]
        told = weight * (_slope(flows[0], 0) + _slope(flows[1], 1))
        return np.concatenate([told.ravel(), _TIGHTNESS * vector.ravel()])

    def backwards(vector: np.ndarray) -> np.ndarray:
        told = weight * vector[:half].reshape(tau.shape)
        parts = [smooth(-tau * _slope(told, axis)).ravel() for axis in (0, 1)]
        return np.concatenate(parts) + _TIGHTNESS * vector[half:]

    operator = LinearOperator((3 * half, 2 * half), matvec=forwards, rmatvec=backwards, dtype=np.float64)  # type: ignore[call-arg]
    wanted = np.concatenate([-(weight * residual).ravel(), np.zeros(2 * half)])
    found = lsqr(operator, wanted, atol=0.0, btol=0.0, conlim=0.0, iter_lim=_ITERATIONS)[0]
    return np.stack([smooth(part) for part in found.reshape(2, *tau.shape)], axis=-1)


def _slope(values: np.ndarray, axis: int) -> np.ndarray:
    """Central difference, nothing beyond the border: its adjoint is its negative."""
    padded = np.pad(values, [(1, 1) if index == axis else (0, 0) for index in range(2)])
    first, last = (np.delete(padded, edge, axis) for edge in ((-1, -2), (0, 1)))
    return 0.5 * (last - first)
