"""How right the volumes of a fit, and its particles, are for plumes that the prior was held back from.

    .venv/backend/bin/python -m training.judge --plumes DIR --json FILE [--preset draft] [--weights FILE]

A scene of the benchmark is one plume, and what is chosen by three of them may be chosen by chance; here are as many as were held
back, in any wind. Each is filmed as the benchmark's are, and its volumes are made as a fit makes them
(`backend/stages/volume.py`), on the grids that the pictures alone ask for and on those that the prior then moves to where it sees
the smoke. The particles that a fit makes of the latter are judged, too: what is better of volumes is not always better of them.
The preset is that of the particles.
"""

from __future__ import annotations

from backend import kernel_setup  # noqa: F401 before numba loads

# isort: split
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.job import Config, VolumeConfig
from backend.field.rays import optical_depth
from backend.fit.guide import Guide
from backend.fit.state import VisualRecord, VolumeRecord, particle_frame
from backend.geometry.camera import View, view_at
from backend.prior.predict import Prior
from backend.render.motion import smoke_and_motion
from backend.render.picture import picture
from backend.reporting import Report, SilentReport
from backend.score.measures import coded, correlation, decibels, velocity_scores
from backend.score.volumes import camera_axes
from backend.stages import visual, volume
from synthetic.sweep import Orbit, orbit_cameras, still_cameras
from training.judge_command import judge_all
from training.library import FPS, NUM_FRAMES, VELOCITY_EVERY, Plume
from training.samples import lattice_of, truth
from training.train import held_back

SIZE = 90, 160  # px
LIGHT = 0.4  # of opaque smoke, linear
SEEN = 120  # frames of a clip
_VIEWS = {"nvs_last_db": 0.0, "side_db": 90.0}  # degrees from the first place of the camera
_FAINT = 20.0  # 1/m, summed over the voxels: a moment with less shows no smoke
_LEVEL = 0.02  # of the fullest level: those with less are not asked where they are


def film(plume: Plume, draw: np.random.Generator) -> tuple[list[np.ndarray], Cameras]:
    """Smoke layers [H, W, 4] of the frames that are seen, in eight bits with noise, and the cameras."""
    cameras = going_around()
    return filmed_by(plume, cameras, draw), replace(cameras, camera_to_world=cameras.camera_to_world[:SEEN])


def going_around() -> Cameras:
    """Of all frames of a plume, those behind the clip among them."""
    width, height = SIZE
    return orbit_cameras(Orbit(), width=width, height=height, fps=FPS, num_frames=NUM_FRAMES)


def filmed_by(plume: Plume, cameras: Cameras, draw: np.random.Generator) -> list[np.ndarray]:
    """The layers alone."""
    layers = []
    for frame in range(SEEN):
        opacity = opacity_of(plume, frame, view_at(cameras, frame))
        opacity = np.clip(np.round(255 * opacity + draw.normal(0, 0.5, opacity.shape)), 0, 254) / 255
        layers.append(layer_of(opacity))
    return layers


def layer_of(opacity: np.ndarray) -> np.ndarray:
    """[H, W] -> [H, W, 4] float32 premultiplied linear light: evenly lit smoke."""
    return np.dstack([LIGHT * opacity] * 3 + [opacity]).astype(np.float32)


def opacity_of(plume: Plume, frame: int, view: View) -> np.ndarray:
    """[H, W] of the true smoke."""
    return -np.expm1(-optical_depth(plume.density_at(frame), lattice_of(plume), view, step=0.5))


def volumes_of(
    layers: list[np.ndarray], cameras: Cameras, prior: Prior, settings: VolumeConfig, report: Report
) -> list[VolumeRecord] | None:
    """As a job makes them; None of a clip without smoke."""
    plan = volume.make_plan(
        layers, cameras, stride=settings.stride, every=settings.every, finer=settings.finer, as_wide=settings.as_deep_as_wide
    )
    if plan is None:
        return None
    plan = volume.centred(plan, report, prior=prior)
    proposals = list(volume.propose(plan, report, prior=prior, done=[]))
    return list(volume.run(plan, report, proposals, levels=prior.levels, shares=prior.shares))


def judge(plume: Plume, records: list[VolumeRecord]) -> dict[str, float]:
    """Means over moments, on the grids' voxels: PSNR of the picture as the benchmark scores it (sRGB: thin smoke counts), from
    the first place in the last third of the clip and from aside, dB; correlations of density, and of velocity inside smoke; and
    how far the middle of a level lies from the true one in depth, m, root of the mean square over the smoke."""
    rows = []
    for frame in moments(plume):
        guide = Guide(records[frame])
        stand, own = guide.stand, guide.stand.from_world[:3, :3]
        density, velocity = truth(plume, frame, stand)
        row = _row((guide.density, guide.velocity @ own.T), (density, velocity), axes=np.eye(3)[[0, 2, 1]])
        row["level_m"] = stand.lattice.voxel_size * levels_off(guide.density, density)
        for name, view in _views(frame).items():
            shown = -np.expm1(-optical_depth(guide.density, stand.lattice, stand.seen(view)))
            row[name] = likeness(layer_of(shown), plume, frame, view)
        rows.append(row)
    return _means(rows)


def judge_particles(
    plume: Plume, cameras: Cameras, records: list[VisualRecord], *, views: Callable[[int], dict[str, View]] | None = None
) -> dict[str, float]:
    """As `judge`, of the Gaussians of all frames, on the plume's own voxels; where levels lie is not asked. views: of a frame,
    from where it is looked at, in place of `judge`'s."""
    rows = []
    for frame in moments(plume):
        ours = particle_frame(records[frame])
        real = plume.density_at(frame), plume.velocity_at(frame)
        row = _row(smoke_and_motion(ours, lattice_of(plume)), real, axes=camera_axes(view_at(cameras, frame)))
        for name, view in (views or _views)(frame).items():
            row[name] = likeness(picture(ours, view), plume, frame, view)
        rows.append(row)
    return _means(rows)


def _row(ours: tuple[np.ndarray, np.ndarray], real: tuple[np.ndarray, np.ndarray], *, axes: np.ndarray) -> dict[str, float]:
    """Correlations of density [X, Y, Z] and velocity [X, Y, Z, 3]; axes [3, 3]: rows sideways, up and in depth."""
    moves = velocity_scores(ours[1], real[1], real[0], axes)
    return {"density": correlation(ours[0], real[0])} | {
        name: moves[f"correlation_{name}"] for name in ("sideways", "depth", "up")
    }


def _means(rows: list[dict[str, float]]) -> dict[str, float]:
    """Of each name over the rows that have it."""
    names = {name: None for row in rows for name in row}
    return {name: round(float(np.nanmean([row[name] for row in rows if name in row])), 4) for name in names}


def moments(plume: Plume) -> list[int]:
    """The frames that are judged: those with velocities, and with smoke."""
    return [t for t in range(0, SEEN, 2 * VELOCITY_EVERY) if plume.density_at(t).sum(dtype=np.float64) > _FAINT]


def _views(frame: int) -> dict[str, View]:
    """From where a frame is looked at; from the first place late in the clip alone, when the camera has gone far."""
    return {name: view_at(standing(degrees), 0) for name, degrees in _VIEWS.items() if degrees or frame >= 2 * SEEN // 3}


def standing(degrees: float) -> Cameras:
    """So far around from the first place of the camera that goes around."""
    width, height = SIZE
    return still_cameras(Orbit(), turned=degrees, width=width, height=height, fps=FPS)


def likeness(shown: np.ndarray, plume: Plume, frame: int, view: View) -> float:
    """PSNR of a picture [H, W, 4], dB."""
    wrong = coded(shown) - coded(layer_of(opacity_of(plume, frame, view)))
    return decibels(float(np.square(wrong).mean(dtype=np.float64)))


def levels_off(ours: np.ndarray, real: np.ndarray) -> float:
    """Voxels between the middles in depth of the levels of two densities [X, Y, Z], root of the mean square over the smoke."""
    masses = [density.sum(axis=(0, 1), dtype=np.float64) for density in (ours, real)]
    counted = (masses[0] > _LEVEL * masses[0].max()) & (masses[1] > _LEVEL * masses[1].max())
    if not counted.any():
        return math.nan
    at = np.arange(ours.shape[1], dtype=np.float64)
    middles = [
        np.einsum("xyz,y->z", density[..., counted], at) / mass[counted]
        for density, mass in zip((ours, real), masses, strict=True)
    ]
    return math.sqrt(np.average(np.square(middles[0] - middles[1]), weights=masses[1][counted]))


def judged(plume: Plume, prior: Prior, config: Config) -> dict[str, Any]:
    """Of the plume its wind, m/s; of volumes on grids as the pictures alone ask for them and as the prior moves them, and of
    particles made of the latter, what `judge` and `judge_particles` say."""
    report = SilentReport()
    layers, cameras = film(plume, np.random.default_rng(plume.scene.seed))
    plan = volume.make_plan(layers, cameras, every=5)
    found: dict[str, Any] = {"wind": round(float(np.hypot(*plume.scene.wind)), 3)}
    if plan is None:
        return found
    records = []
    for name, way in (("by the pictures", plan), ("by the prior", volume.centred(plan, report, prior=prior))):
        proposals = list(volume.propose(way, report, prior=prior, done=[]))
        records = list(volume.run(way, report, proposals, levels=prior.levels, shares=prior.shares))
        found[name] = judge(plume, records)
    particles = list(visual.run(layers, cameras, [], config.visual, report, seed=0, done=[], volumes=records))
    return found | {"particles": judge_particles(plume, cameras, particles)}


def main(arguments: list[str]) -> int:
    return judge_all(arguments, judged, description=__doc__, label="judge volumes", chosen=held_back)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
