"""Levels of a proposal brought to where in depth the whole clip says that they are.

Two networks speak of it: the large one, for a frame, of every voxel, and a small one, from the whole clip, of the levels' middles
and of how unsure it is of them. Mostly the large one is right to less than a voxel, which the small one cannot better; but there
are clips that it loses its way in, by metres and from beginning to end. Those are known by how far the two are apart.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from backend.fit.region import Region
from backend.prior.levels import LevelNet, ask
from backend.prior.predict import Proposal, one_thread
from backend.prior.sheets import UNIT, look_at_sheets, moments_around, parts
from backend.prior.window import Stand

# Tuned on ten held-back plumes and three scenes, USUAL on eleven finer plumes and the scenes; forty others bear it out.
OWN_ERROR = 2.0  # voxels that the middle of a proposal's level is taken to be off
USUAL = 0.6  # voxels that the two are apart in a clip in which the large one may as well have lost its way as not
_POWER = 8  # how soon it is one or the other
_SMOOTH = 1.5  # voxels of height, standard deviation: neighbouring levels move alike
_FAINT = 0.01  # of the fullest level: one with less does not move of itself


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """Of the grid of a frame, in voxels of the prior's: where along it the middle of each column's smoke is [X, Z], how wide that
    smoke is [Z], how unsure the middle is [Z], and whether the level was asked [Z], from 0 to 1."""

    middle: np.ndarray
    width: np.ndarray
    unsure: np.ndarray
    asked: np.ndarray


class Levels:
    """Of a clip, in its upright world. stride: frames; share: of the way that levels go, all of it until `weigh` is told more;
    apart: voxels between the two networks, root of the mean square over the clip's smoke."""

    def __init__(self, region: Region, net: LevelNet, *, stride: int) -> None:
        self.region, self.net, self.stride = region, net, stride
        self.share, self.apart = 1.0, USUAL
        self.known: dict[tuple[int, int], tuple[np.ndarray, ...]] = {}

    def weigh(self, proposals: Iterable[tuple[Proposal, int]]) -> None:
        """By all that is proposed of the clip, each with its frame: whether the large network has lost its way in it."""
        squares = total = 0.0
        for proposal, frame in proposals:
            apart, _, weight = self._apart(proposal, frame)
            squares += float(weight @ np.square(apart))
            total += float(weight.sum())
        self.apart = (squares / total) ** 0.5 if total else 0.0
        self.share = self.apart**_POWER / (self.apart**_POWER + USUAL**_POWER)

    def levelled(self, proposal: Proposal, frame: int, *, share: float | None = None) -> Proposal:
        """Each level moved along the view, with its velocities: the more of the way the surer the small network is; share: of all
        of it, in place of the clip's own."""
        apart, unsure, weight = self._apart(proposal, frame)
        if not weight.any():
            return proposal
        trust = (self.share if share is None else share) * OWN_ERROR**2 / (OWN_ERROR**2 + unsure**2)
        smooth = _SMOOTH * self.finer(proposal.stand)
        total = ndimage.gaussian_filter1d(weight, smooth, mode="constant")
        shift = ndimage.gaussian_filter1d(weight * trust * apart, smooth, mode="constant") / (total + 1e-6)
        shift *= self.finer(proposal.stand)
        return replace(
            proposal, density=moved(proposal.density, shift), velocity=moved(proposal.velocity, shift, outside="nearest")
        )

    def finer(self, stand: Stand) -> float:
        """Voxels of a stand to one of the prior's, in which all lengths here are."""
        return self.region.voxel_size / stand.lattice.voxel_size

    def _apart(self, proposal: Proposal, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of each level [Z]: voxels from where the proposal has its middle to where the small network does, how unsure that is in
        voxels, and how much it counts, up to 1."""
        columns = proposal.density.sum(axis=1, dtype=np.float64)  # [X, Z]
        mass = columns.sum(axis=0)
        told = self.told(proposal.stand, frame)
        counted = columns * told.asked
        seen = counted.sum(axis=0)
        at = np.arange(proposal.density.shape[1]) / self.finer(proposal.stand)
        own = np.einsum("xyz,y->z", proposal.density, at) / np.maximum(mass, 1e-12)
        aim = (counted * told.middle).sum(axis=0) / np.maximum(seen, 1e-12)
        weight = np.where((seen > 0) & (mass > _FAINT * mass.max(initial=0.0)), mass, 0.0)
        return aim - own, told.unsure, weight / max(float(weight.max(initial=0.0)), 1e-12)

    def told(self, stand: Stand, frame: int) -> Told:
        """What the small network says of the columns of a frame's grid."""
        frames = moments_around(frame, stride=self.stride, num_frames=self.region.num_frames)
        heights, *said = self._heard(frames)
        later = int(np.clip(np.searchsorted(frames, frame), 1, len(frames) - 1))
        share = np.clip((frame - frames[later - 1]) / max(int(frames[later] - frames[later - 1]), 1), 0.0, 1.0)
        middle, width, unsure, asked = ((1.0 - share) * values[later - 1] + share * values[later] for values in said)
        finer = self.finer(stand)
        own, source = stand.centres()[0, 0, :, 2], stand.voxels(self.region.source[None])[0] / finer
        at = (np.arange(stand.lattice.shape[0]) / finer - source[0]) / UNIT
        across = [np.interp(at, parts(), row) for row in middle]  # of each level [X]
        deep = np.stack([np.interp(own, heights, column) for column in np.transpose(across)])
        width, unsure, asked = (np.interp(own, heights, values) for values in (width, unsure, asked))
        return Told(middle=source[1] + UNIT * deep, width=UNIT * width, unsure=UNIT * unsure, asked=asked)

    def _heard(self, frames: np.ndarray) -> tuple[np.ndarray, ...]:
        """Heights [Z] m, and what the network says of these frames; windows that reach as far are heard once."""
        key = int(frames[0]), int(frames[-1])
        if key not in self.known:
            region = self.region
            sheets = look_at_sheets(
                lambda number: region.pictures.depths[number],
                lambda number: region.pictures.views[number],
                region.source,
                frames,
                height=float(region.centre[2]),
                voxel_size=region.voxel_size,
                stride=self.stride,
            )
            with one_thread():
                self.known[key] = sheets.heights, *ask(self.net, sheets)
        return self.known[key]


def moved(values: np.ndarray, shift: np.ndarray, *, outside: str = "constant") -> np.ndarray:
    """Values [X, Y, Z, ..] of a grid whose levels move by shift [Z] voxels along Y, linearly; float32."""
    reach = int(np.ceil(np.abs(shift).max(initial=0.0))) + 1
    mode = "edge" if outside == "nearest" else "constant"
    padded = np.pad(values, [(0, 0), (reach, reach)] + [(0, 0)] * (values.ndim - 2), mode=mode)
    at = np.arange(values.shape[1])[:, None] + reach - shift  # [Y, Z]
    low = np.floor(at).astype(np.int64)
    share = (at - low).astype(np.float32).reshape(*at.shape, *[1] * (values.ndim - 3))
    level = np.arange(values.shape[2])
    return (1 - share) * padded[:, low, level] + share * padded[:, low + 1, level]
