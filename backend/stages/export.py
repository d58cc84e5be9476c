"""particles.h5 -> VDB sequence: one voxel size and one lattice for all frames, each cropped to its smoke.

`plan_export` looks at every frame once and settles what holds for the sequence; `run` yields the grids of one frame
after another, and `write_sequence` writes them as smoke_0001.vdb and on, frame 0 being the first fitted one.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from backend.contract.errors import BackendError
from backend.contract.job import ExportConfig
from backend.contract.result import vdb_path
from backend.geometry.lattice import Lattice
from backend.io.particles import ParticleFrame, Particles
from backend.io.vdb import write_vdb
from backend.render.motion import unblurred
from backend.render.voxelize import CUTOFF, splat_extents, voxelize
from backend.reporting import Report

Vector = tuple[float, float, float]

BLURRED = 0.1  # share of the optical mass whose Gaussians may be narrower than a voxel
COLOR_THRESHOLD = 0.04  # weighted standard deviation of a linear colour channel, relative to the brightest mean channel

SMALLEST_VOXEL = 1.5e-5  # m; OpenVDB takes the transform of smaller ones (volume below 3e-15 m^3) for singular

_TRIM = 5e-4  # share of the optical mass on either side of an axis that may be left out where it would coarsen all the rest
_COARSE = 10.0  # times the size that the particles ask for: worth a warning
_MAX_LOST = 2e-3  # share of the optical mass lost through trimming that is worth a warning
_MARGIN = 6  # voxels: widening to MIN_SCALE_VOXELS and rounding outward on both sides


@dataclass(frozen=True, slots=True, kw_only=True)
class VdbFrame:
    """The grids of one frame, ready to be written. frame counts from the first fitted one."""

    frame: int
    grids: dict[str, np.ndarray]  # density [X, Y, Z] 1/m, velocity [X, Y, Z, 3] m/s, color [X, Y, Z, 3] linear
    voxel_size: float  # m
    origin: Vector  # m, centre of voxel (0, 0, 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportPlan:
    """What holds for the whole sequence. smoke_color: mean over all optical mass; bounds: low and high, m."""

    voxel_size: float  # m
    is_trimmed: bool
    has_color: bool
    smoke_color: Vector
    bounds: tuple[Vector, Vector]


def plan_export(particles: Particles, config: ExportConfig, report: Report) -> ExportPlan:
    """Voxel size, colour and bounds of a sequence, from one pass over all of its frames."""
    survey = _survey(particles)
    wanted = config.voxel_size or (survey.narrow_scale or 1.0)
    is_trimmed = survey.longest_side > wanted * (config.max_voxels - _MARGIN)
    longest = survey.longest_trimmed_side if is_trimmed else survey.longest_side
    voxel_size = max(wanted, longest / (config.max_voxels - _MARGIN), SMALLEST_VOXEL)
    if voxel_size == SMALLEST_VOXEL:
        report.warning(
            "voxel_size_limited",
            f"Voxels of {wanted:g} m are smaller than OpenVDB can hold; they are {voxel_size:g} m. A larger scene has room for "
            "detail: set cameras.distance_m, or give cameras in larger units.",
        )
    elif not config.voxel_size and voxel_size > _COARSE * wanted:
        report.warning(
            "voxels_coarse",
            f"The smoke spans {longest:.3g} m, so that its voxels are {voxel_size:.3g} m where particles ask for {wanted:.3g} m: "
            "some of it lies far off. A larger export.max_voxels allows finer ones.",
        )
    elif config.voxel_size and voxel_size > config.voxel_size:
        report.warning(
            "voxel_size_limited",
            f"Voxels of {config.voxel_size:g} m would need more than {config.max_voxels} a side; they are {voxel_size:g} m. "
            "A larger export.max_voxels allows finer ones.",
        )
    return ExportPlan(
        voxel_size=voxel_size,
        is_trimmed=is_trimmed,
        has_color=survey.color_spread > COLOR_THRESHOLD,
        smoke_color=survey.smoke_color,
        bounds=survey.bounds,
    )


def run(
    particles: Particles,
    config: ExportConfig,
    report: Report,
    *,
    start: int = 0,
    stop: int | None = None,
    plan: ExportPlan | None = None,
    existing: Collection[int] = (),
) -> Iterator[VdbFrame]:
    """The frames start to stop - 1 (all by default) that are not in `existing`, one at a time."""
    plan = plan or plan_export(particles, config, report)
    total = particles.num_frames + particles.num_forecast
    stop = total if stop is None else stop
    if not 0 <= start < stop <= total:
        raise BackendError(
            "bad_frame_range",
            f"There are no frames {start}:{stop}.",
            hint=f"Give A:B within 0:{total}; the forecast is included.",
        )
    for frame in range(start, stop):
        if frame not in existing:
            yield _vdb_frame(particles.frame(frame), frame, plan, report)
        report.progress(frame + 1 - start, stop - start)


def write_sequence(frames: Iterator[VdbFrame], folder: Path) -> Iterator[tuple[int, Path]]:
    """Write each frame as it comes, whole or not at all; yields its number and path. Raises BackendError."""
    folder.mkdir(parents=True, exist_ok=True)
    for item in frames:
        path = vdb_path(folder, item.frame)
        write_vdb(path, item.grids, voxel_size=item.voxel_size, origin=item.origin)
        yield item.frame, path


@dataclass(frozen=True, slots=True, kw_only=True)
class _Survey:
    narrow_scale: float  # m: the share BLURRED of the smoke is narrower; the middle of all frames, 0 without smoke
    longest_side: float  # m, of the largest frame
    longest_trimmed_side: float
    color_spread: float
    smoke_color: Vector
    bounds: tuple[Vector, Vector]


def _survey(particles: Particles) -> _Survey:
    scales: list[float] = []
    sides, trimmed_sides = [0.0], [0.0]
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    mass, color_sum, color_squares = 0.0, np.zeros(3), np.zeros(3)
    for index in range(particles.num_frames + particles.num_forecast):
        frame = _visible(particles.frame(index))
        if not frame.count:
            continue
        scales.append(_weighted_quantile(frame.scales.reshape(frame.count, -1).min(axis=1), frame.optical_masses, BLURRED))
        frame_low, frame_high = _bounds(frame, 0.0, is_trimmed=False)
        trimmed_low, trimmed_high = _bounds(frame, 0.0, is_trimmed=True)
        sides.append(float((frame_high - frame_low).max()))
        trimmed_sides.append(float((trimmed_high - trimmed_low).max()))
        low, high = np.minimum(low, frame_low), np.maximum(high, frame_high)
        weights, colors = frame.optical_masses.astype(np.float64), frame.colors.astype(np.float64)
        mass += weights.sum()
        color_sum += weights @ colors
        color_squares += weights @ colors**2
    mean = color_sum / mass if mass > 0 else np.zeros(3)
    variance = np.maximum(color_squares / mass - mean**2, 0.0) if mass > 0 else np.zeros(3)
    if not scales:
        low, high = np.zeros(3), np.zeros(3)
    return _Survey(
        narrow_scale=float(np.median(scales)) if scales else 0.0,
        longest_side=max(sides),
        longest_trimmed_side=max(trimmed_sides),
        color_spread=float(np.sqrt(variance.max()) / max(float(np.abs(mean).max()), 1e-12)),
        smoke_color=_vector(mean),
        bounds=(_vector(low), _vector(high)),
    )


def _vdb_frame(frame: ParticleFrame, index: int, plan: ExportPlan, report: Report) -> VdbFrame:
    frame = _visible(frame)
    lattice = _lattice(frame, plan)
    grids = voxelize(unblurred(frame), lattice, with_color=plan.has_color)
    if plan.is_trimmed and frame.count:
        total = float(frame.optical_masses.sum(dtype=np.float64))
        kept = float(grids["density"].sum(dtype=np.float64)) * plan.voxel_size**3
        if kept < (1.0 - _MAX_LOST) * total:
            report.warning(
                "smoke_outside",
                f"Frame {index}: {100 * (1 - kept / total):.1f} % of the smoke lies far outside and is left out of the VDB.",
            )
    return VdbFrame(frame=index, grids=grids, voxel_size=plan.voxel_size, origin=lattice.origin)


def _lattice(frame: ParticleFrame, plan: ExportPlan) -> Lattice:
    """The voxels around a frame's smoke, on the lattice that passes through the world's origin: nothing jumps in between."""
    h = plan.voxel_size
    if not frame.count:
        return Lattice(origin=(0.0, 0.0, 0.0), voxel_size=h, shape=(0, 0, 0))
    low, high = _bounds(frame, h, is_trimmed=plan.is_trimmed)
    first, last = np.floor(low / h), np.ceil(high / h)
    x, y, z = (int(count) for count in last - first + 1)
    return Lattice(origin=_vector(first * h), voxel_size=h, shape=(x, y, z))


def _bounds(frame: ParticleFrame, voxel_size: float, *, is_trimmed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Low and high [3] m of a frame's Gaussians; trimmed: of all but _TRIM of the optical mass on either side."""
    extents = (
        splat_extents(frame, voxel_size)
        if voxel_size > 0
        else CUTOFF * frame.scales.reshape(frame.count, -1).max(axis=1)[:, None]
    )
    low, high = frame.positions - extents, frame.positions + extents
    if not is_trimmed:
        return low.min(axis=0), high.max(axis=0)
    lowest = [_weighted_quantile(low[:, axis], frame.optical_masses, _TRIM) for axis in range(3)]
    highest = [_weighted_quantile(high[:, axis], frame.optical_masses, 1.0 - _TRIM) for axis in range(3)]
    return np.array(lowest), np.array(highest)


def _weighted_quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order], dtype=np.float64)
    place = int(np.searchsorted(sums, share * sums[-1]))
    return float(values[order[min(place, len(order) - 1)]])


def _visible(frame: ParticleFrame) -> ParticleFrame:
    """The frame without particles that hold no smoke: they shape neither bounds nor voxel size."""
    keep = frame.optical_masses > 0
    if keep.all():
        return frame
    return ParticleFrame(
        positions=frame.positions[keep],
        velocities=frame.velocities[keep],
        scales=frame.scales[keep],
        optical_masses=frame.optical_masses[keep],
        colors=frame.colors[keep],
        ids=frame.ids[keep],
        rotations=None if frame.rotations is None else frame.rotations[keep],
    )


def _vector(values: np.ndarray) -> Vector:
    x, y, z = (float(value) for value in values)
    if not all(math.isfinite(value) for value in (x, y, z)):
        raise ValueError("a bound or colour is not finite")
    return (x, y, z)
