"""The clip's light from the shading of its smoke: where the sun stands, how bright it is, and what else there is.

Thin smoke shows L = S p exp(-s d(x)) + A a(x): d is the optical depth between x and the sun, s < 1 because light scattered
forwards goes on (similarity: s = 1 - g, van de Hulst 1980), a the mean of the same over the sky. p is the phase function
(backend/render/scattering.py) of the angle by which sunlight is turned to get to the camera: while that goes around the smoke,
all of it becomes brighter or darker. A pixel shows the mean of L along its ray, each place as it is seen through what is before
it. S and A are a non-negative least squares (Lawson and Hanson 1974). The direction of the sun is the one that explains most of
the shading within each picture, for smoke becomes brighter for other reasons, too; then p is the most likely one of all pictures
together. All of it is done on a few small ones, and what counts is what it explains of others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy import ndimage
from scipy.optimize import nnls

from backend.contract.light import Light
from backend.field.shadow import depth_towards
from backend.geometry.camera import View, resized
from backend.geometry.lattice import Lattice
from backend.io.particles import ParticleFrame
from backend.render.scattering import phase
from backend.render.voxelize import voxelize

LEAST_EXPLAINED = 0.3  # of the colour's variation, on other frames: less is no shading
LEAST_VARIATION = 0.05  # of the mean brightness: smoke of one brightness shows no light
SOFTNESS = (0.35, 0.7, 1.0)
ANISOTROPY = tuple(0.05 * step for step in range(13))
USUAL_ANISOTROPY, OTHERS = 0.25, 0.1  # what it is taken to be before anything is seen, and the standard deviation of that. The
# benchmark's smoke scatters so, too: where its cameras go around it, they tell the same without this (docs/method.md)
SIGHTS = 20.0  # as many observations that are independent of each other are in the pictures
NUM_FRAMES = 8
_SIDE = 44  # px
_CELLS = 26  # of the longest side
_SAMPLES = 40  # along a ray
_OPAQUE = 0.15  # pixels that show less smoke are not looked at
_DIRECTIONS = 120  # all around; then closer ones
_NEAR = (14.0, 6.0)  # degrees from the best so far
_AS_GOOD = 0.05  # of what is explained: directions that explain so much less are not worse


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """A frame: its particles, its camera and its smoke layer [H, W, 4], linear premultiplied RGB and opacity."""

    particles: ParticleFrame
    view: View
    layer: np.ndarray


@dataclass(frozen=True, kw_only=True)
class _Rays:
    """Of one shot. ahead [3]: from the camera to the smoke, of length 1; colors [P, 3]; places [3, P, S] voxels of the lattice;
    weights [P, S], one in sum along each ray."""

    density: np.ndarray
    lattice: Lattice
    ahead: np.ndarray
    colors: np.ndarray
    places: np.ndarray
    weights: np.ndarray

    @cached_property
    def sky(self) -> dict[float, np.ndarray]:
        """Of each softness [P]: what the rays show of an even sky of brightness one."""
        ways = evenly(26)
        depths = [depth_towards(self.density, self.lattice, way) for way in ways[ways[:, 2] > 0]]
        return {softness: self.shown(np.mean([np.exp(-softness * depth) for depth in depths], axis=0)) for softness in SOFTNESS}

    def shown(self, light: np.ndarray) -> np.ndarray:
        """[P]: what the rays show of a light [X, Y, Z] on the lattice."""
        return (self.weights * ndimage.map_coordinates(light, self.places, order=1, mode="nearest")).sum(axis=1)


def find_light(shots: Sequence[Shot]) -> Light | None:
    """The light that explains the shading; None where the smoke shows none. Every other shot is for the proof."""
    rays = [found for shot in shots if (found := _rays(shot)) is not None]
    if len(rays) < 2:
        return None
    taught, proof, whole = _Search(rays[::2]), _Search(rays[1::2]), _Search(rays)
    if not whole.brightness.std() > LEAST_VARIATION * whole.brightness.mean():
        return None
    tried = evenly(_DIRECTIONS)
    errors = np.array([taught.error(way, SOFTNESS[1]) for way in tried])
    direction = tried[int(np.argmin(errors))]
    softness = SOFTNESS[int(np.argmin([taught.error(direction, one) for one in SOFTNESS]))]
    for degrees in _NEAR:
        direction = taught.closer(direction, degrees, softness)
    learned = taught.anisotropy(direction, softness)
    weights, _ = _solved(taught.columns(direction, softness, learned), taught.brightness)
    missed = np.square(proof.brightness - proof.columns(direction, softness, learned) @ weights).sum()
    explained = 1.0 - float(missed / np.square(proof.brightness - taught.brightness.mean()).sum())
    if not explained >= LEAST_EXPLAINED:
        return None
    anisotropy = whole.anisotropy(direction, softness)
    columns = whole.columns(direction, softness, anisotropy)
    parts = np.array([_solved(columns, whole.colors[:, channel])[0] for channel in range(3)])
    even = whole.columns(direction, softness, 0.0).mean(axis=0) * parts.mean(axis=0)
    least = taught.error(direction, softness)
    as_good = np.vstack([direction, tried[errors <= least + _AS_GOOD * (taught.variation - least)]])
    angles = np.degrees(np.arccos(np.clip(as_good @ direction, -1.0, 1.0)))
    return Light(
        direction=_triple(direction),
        sun=_triple(parts[:, 0]),
        ambient=_triple(parts[:, 1]),
        softness=softness,
        explained=explained,
        doubt_degrees=float(np.sqrt(np.square(angles).mean())),
        anisotropy=anisotropy,
        sun_share=float(even[0] / even.sum()),
    )


class _Search:
    """Directions of the sun against the brightness [P] of all rays together."""

    def __init__(self, rays: list[_Rays]) -> None:
        self.rays = rays
        self.colors = np.concatenate([item.colors for item in rays])
        self.brightness = self.colors.mean(axis=1)
        self._sky = {softness: np.concatenate([item.sky[softness] for item in rays]) for softness in SOFTNESS}

    def closer(self, direction: np.ndarray, degrees: float, softness: float) -> np.ndarray:
        """The best of a direction and of six around it."""
        side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
        side /= np.linalg.norm(side)
        other, tilt = np.cross(direction, side), np.radians(degrees)
        around = np.radians(60.0 * np.arange(6))[:, None]
        ring = np.cos(tilt) * direction + np.sin(tilt) * (np.cos(around) * side + np.sin(around) * other)
        tried = np.vstack([direction, ring])
        return tried[int(np.argmin([self.error(way, softness) for way in tried]))]

    def error(self, direction: np.ndarray, softness: float) -> float:
        """Of the shading within each picture, each with a sun and a sky of its own brightness."""
        parts = zip(self._by_shot(self.columns(direction, softness, 0.0)), self._by_shot(self.brightness), strict=True)
        return sum(_solved(*part)[1] for part in parts)

    @property
    def variation(self) -> float:
        """Squares of the brightness within each picture, about its mean."""
        return sum(float(np.square(part - part.mean()).sum()) for part in self._by_shot(self.brightness))

    def _by_shot(self, values: np.ndarray) -> list[np.ndarray]:
        return np.split(values, np.cumsum([len(item.colors) for item in self.rays])[:-1])

    def anisotropy(self, direction: np.ndarray, softness: float) -> float:
        """The most likely one. Of a camera that hardly turns all explain the same, and the usual one stays."""
        sun, sky = self._sun(direction, softness), self._sky[softness]
        columns = [np.stack([sun * self._phase(direction, one), sky], axis=1) for one in ANISOTROPY]
        errors = np.array([_solved(each, self.brightness)[1] for each in columns])
        unusual = (np.array(ANISOTROPY) - USUAL_ANISOTROPY) / OTHERS
        return ANISOTROPY[int(np.argmin(SIGHTS * errors / max(float(errors.min()), 1e-30) + unusual * unusual))]

    def columns(self, direction: np.ndarray, softness: float, anisotropy: float) -> np.ndarray:
        """[P, 2]: what the rays show of a sun and of a sky of brightness one."""
        return np.stack([self._sun(direction, softness) * self._phase(direction, anisotropy), self._sky[softness]], axis=1)

    def _sun(self, direction: np.ndarray, softness: float) -> np.ndarray:
        shadows = (np.exp(-softness * depth_towards(item.density, item.lattice, direction)) for item in self.rays)
        return np.concatenate([item.shown(shadow) for item, shadow in zip(self.rays, shadows, strict=True)])

    def _phase(self, direction: np.ndarray, anisotropy: float) -> np.ndarray:
        """[P]: by which sunlight goes on to the cameras."""
        values = phase(anisotropy, np.array([item.ahead @ direction for item in self.rays]))
        return np.repeat(values, [len(item.colors) for item in self.rays])


def evenly(count: int) -> np.ndarray:
    """[count, 3] unit vectors all around, as even as a spiral gets (Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    height, angle = 1.0 - 2.0 * index / count, np.pi * (1.0 + 5.0**0.5) * index
    radius = np.sqrt(1.0 - height * height)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def _solved(columns: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights of the columns, none negative, and the squared error."""
    weights, size = nnls(columns, wanted)
    return weights, float(size) ** 2


def _rays(shot: Shot) -> _Rays | None:
    """What a shot's pixels see, at a small size; None where it shows next to no smoke."""
    if shot.particles.count < 8:
        return None
    height, width = shot.layer.shape[:2]
    share = min(1.0, _SIDE / max(height, width))
    size = max(1, round(width * share)), max(1, round(height * share))
    small = cv2.resize(shot.layer, size, interpolation=cv2.INTER_AREA)
    view = resized(shot.view, size)
    rows, columns = np.nonzero(small[..., 3] > _OPAQUE)
    lattice = _lattice(shot.particles)
    if len(rows) < 8 or lattice is None:
        return None
    density = np.ascontiguousarray(voxelize(shot.particles, lattice)["density"], np.float32)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    first, last = lattice.origin, np.array(lattice.origin) + lattice.voxel_size * (np.array(lattice.shape) - 1)
    middle = float(view.to_camera(0.5 * (first + last)[None])[0, 2])
    reach = 0.5 * float(np.linalg.norm(last - first)) + lattice.voxel_size
    near = max(middle - reach, 1e-3 * reach)
    depths = near + (middle + reach - near) * (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    points = view.unproject(np.repeat(pixels, _SAMPLES, axis=0), np.tile(depths, len(pixels)))
    places = np.moveaxis((points - first) / lattice.voxel_size, -1, 0).reshape(3, len(pixels), _SAMPLES)
    slant = np.linalg.norm(
        points.reshape(len(pixels), _SAMPLES, 3)[:, 1] - points.reshape(len(pixels), _SAMPLES, 3)[:, 0], axis=1
    )
    tau = ndimage.map_coordinates(density, places, order=1, mode="constant") * slant[:, None]
    weights = np.exp(-(np.cumsum(tau, axis=1) - tau)) * -np.expm1(-tau)
    total = weights.sum(axis=1)
    is_met = total > 0.5 * _OPAQUE
    seen = small[rows, columns]
    if is_met.sum() < 8:
        return None
    ahead = np.average(shot.particles.positions, axis=0, weights=shot.particles.optical_masses) - view.position
    return _Rays(
        density=density,
        lattice=lattice,
        ahead=ahead / max(float(np.linalg.norm(ahead)), 1e-300),
        colors=(seen[:, :3] / seen[:, 3:])[is_met].astype(np.float64),
        places=places[:, is_met],
        weights=weights[is_met] / total[is_met, None],
    )


def _lattice(particles: ParticleFrame) -> Lattice | None:
    """Around nearly all particles, for the few that are far off would make the cells large."""
    low, high = (np.percentile(particles.positions, share, axis=0) for share in (1.0, 99.0))
    margin = 2.0 * float(np.median(particles.scales))
    low, high = low - margin, high + margin
    size = float((high - low).max()) / _CELLS
    if not size > 0.0 or not np.isfinite(size):
        return None
    shape = tuple(int(count) for count in np.maximum(np.ceil((high - low) / size), 2))
    return Lattice(origin=_triple(low + 0.5 * size), voxel_size=size, shape=shape)  # type: ignore[arg-type]


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
