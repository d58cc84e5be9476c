"""Export: one lattice for the sequence, sized by the particles, limited by max_voxels, with the smoke's mass in it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from backend.contract.cameras import Cameras
from backend.contract.errors import BackendError, Cancelled
from backend.contract.job import ExportConfig
from backend.io import vdb
from backend.io.particles import ParticleFrame, Particles, ParticlesInfo, ParticlesWriter, read_particles
from backend.reporting import SilentReport
from backend.stages import export

IDENTITY = tuple(tuple(float(i == j) for j in range(4)) for i in range(4))
CAMERAS = Cameras(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0, fps=24.0, camera_to_world=(IDENTITY,))


def cloud(frame: int, *, n: int = 400, color_spread: float = 0.0, scale: float = 0.1, size: float = 1.0) -> ParticleFrame:
    chance = np.random.default_rng(11)
    colors = 0.5 + color_spread * chance.normal(size=(n, 1)) + np.zeros((n, 3))
    return ParticleFrame(
        positions=chance.uniform(-size, size, (n, 3)) + np.array([0.013 * frame, 0.0, 2.0]),
        velocities=np.tile(np.float32([0.3, 0.0, 0.0]), (n, 1)),
        scales=chance.uniform(0.5 * scale, 1.5 * scale, n).astype(np.float32),
        optical_masses=chance.random(n).astype(np.float32),
        colors=colors.astype(np.float32),
        ids=np.arange(n),
    )


NOTHING = cloud(0, n=0)


@contextmanager
def asset(tmp_path: Path, frames: list[ParticleFrame], *, num_forecast: int = 0) -> Iterator[Particles]:
    with ParticlesWriter(tmp_path / "particles.h5") as writer:
        for index, frame in enumerate(frames):
            writer.append(frame, is_forecast=index >= len(frames) - num_forecast)
        writer.finish(ParticlesInfo(cameras=CAMERAS, gravity=(0.0, 0.0, -9.81)))
    with read_particles(tmp_path / "particles.h5") as particles:
        yield particles


def plan_of(tmp_path: Path, frames: list[ParticleFrame], config: ExportConfig) -> tuple[export.ExportPlan, SilentReport]:
    report = SilentReport()
    with asset(tmp_path, frames) as particles:
        return export.plan_export(particles, config, report), report


def test_the_voxel_size_follows_the_particles(tmp_path: Path) -> None:
    frames = [cloud(0), cloud(1)]
    plan, report = plan_of(tmp_path, frames, ExportConfig(max_voxels=512))
    narrower = [frame.optical_masses[frame.scales < plan.voxel_size].sum() / frame.optical_masses.sum() for frame in frames]
    assert np.mean(narrower) == pytest.approx(export.BLURRED, abs=0.03)
    assert not plan.is_trimmed
    assert report.warnings == []


def test_max_voxels_limits_every_side_of_every_frame(tmp_path: Path) -> None:
    frames = [cloud(0), cloud(1, n=0), cloud(2, scale=0.001), cloud(3, size=0.2)]
    config = ExportConfig(max_voxels=24)
    with asset(tmp_path, [dataclasses.replace(f, ids=f.ids + 1000 * t) for t, f in enumerate(frames)]) as particles:
        shapes = [frame.grids["density"].shape for frame in export.run(particles, config, SilentReport())]
    assert 18 <= max(max(shape) for shape in shapes) <= 24
    assert shapes[1] == (0, 0, 0)


def test_a_given_voxel_size_is_kept_or_the_limit_is_told(tmp_path: Path) -> None:
    plan, report = plan_of(tmp_path, [cloud(0)], ExportConfig(voxel_size=0.05, max_voxels=256))
    assert plan.voxel_size == 0.05
    assert report.warnings == []
    plan, report = plan_of(tmp_path, [cloud(0)], ExportConfig(voxel_size=0.001, max_voxels=32))
    assert plan.voxel_size > 0.05
    assert [code for code, _ in report.warnings] == ["voxel_size_limited"]


def test_a_stray_particle_does_not_coarsen_all_the_rest(tmp_path: Path) -> None:
    calm = cloud(0)
    positions = calm.positions.copy()
    positions[7] = (1000.0, 0.0, 0.0)
    masses = calm.optical_masses.copy()
    masses[7] = 0.01
    frame = dataclasses.replace(calm, positions=positions, optical_masses=masses)
    plan, _ = plan_of(tmp_path, [frame], ExportConfig(max_voxels=64))
    expected, _ = plan_of(tmp_path, [calm], ExportConfig(max_voxels=64))
    assert plan.is_trimmed
    assert plan.voxel_size == pytest.approx(expected.voxel_size, rel=0.1)
    masses[7] = 10.0  # 5 % of the smoke is no stray: it is shown
    plan, _ = plan_of(tmp_path, [dataclasses.replace(frame, optical_masses=masses)], ExportConfig(max_voxels=64))
    assert plan.voxel_size > 10.0


def test_smoke_that_is_left_out_is_told(tmp_path: Path) -> None:
    chance = np.random.default_rng(0)
    frame = cloud(0, n=4000)
    positions = frame.positions.copy()
    for axis in range(3):  # some on either side of every axis, each side below the trim
        positions[axis * 2] += 500.0 * np.eye(3)[axis]
        positions[axis * 2 + 1] -= 500.0 * np.eye(3)[axis]
    masses = chance.uniform(0.9, 1.1, 4000).astype(np.float32)
    masses[:6] = 1.9
    report = SilentReport()
    with asset(tmp_path, [dataclasses.replace(frame, positions=positions, optical_masses=masses)]) as particles:
        list(export.run(particles, ExportConfig(max_voxels=48), report))
    assert [code for code, _ in report.warnings] == ["smoke_outside"]


def test_a_colour_grid_only_where_colours_differ(tmp_path: Path) -> None:
    plan, _ = plan_of(tmp_path, [cloud(0)], ExportConfig())
    assert not plan.has_color
    assert plan.smoke_color == pytest.approx((0.5, 0.5, 0.5))
    plan, _ = plan_of(tmp_path, [cloud(0, color_spread=0.1)], ExportConfig())
    assert plan.has_color
    with asset(tmp_path, [cloud(0, color_spread=0.1)]) as particles:
        (frame,) = export.run(particles, ExportConfig(), SilentReport())
    assert set(frame.grids) == {"density", "velocity", "color"}


def test_the_mean_colour_is_weighted_by_optical_mass(tmp_path: Path) -> None:
    frame = dataclasses.replace(cloud(0, n=2), colors=np.float32([[1, 0, 0], [0, 1, 0]]), optical_masses=np.float32([3, 1]))
    plan, _ = plan_of(tmp_path, [frame], ExportConfig())
    assert plan.smoke_color == pytest.approx((0.75, 0.25, 0.0))


def test_mass_place_and_velocity_of_every_frame(tmp_path: Path) -> None:
    frames = [cloud(0), cloud(1), cloud(2)]
    with asset(tmp_path, frames, num_forecast=1) as particles:
        plan = export.plan_export(particles, ExportConfig(), SilentReport())
        for made, frame in zip(export.run(particles, ExportConfig(), SilentReport(), plan=plan), frames, strict=True):
            density, h = made.grids["density"].astype(np.float64), plan.voxel_size
            assert made.voxel_size == h
            assert density.sum() * h**3 == pytest.approx(frame.optical_masses.sum(dtype=np.float64), rel=1e-4)
            # On the lattice through the world's origin: a smoke that stands still does not swim between frames.
            np.testing.assert_allclose(np.array(made.origin) / h, np.round(np.array(made.origin) / h), atol=1e-6)
            centers = [made.origin[a] + h * np.arange(density.shape[a]) for a in range(3)]
            mean = [float((density.sum(axis=tuple({0, 1, 2} - {a})) * centers[a]).sum() / density.sum()) for a in range(3)]
            expected = np.average(frame.positions, axis=0, weights=frame.optical_masses)
            np.testing.assert_allclose(mean, expected, atol=1e-3)
            assert made.grids["velocity"][density > 0][:, 0] == pytest.approx(0.3, rel=1e-4)
            low, high = plan.bounds
            assert all(low[a] - h <= centers[a][0] and centers[a][-1] <= high[a] + 2 * h for a in range(3))


def test_particles_without_mass_shape_nothing(tmp_path: Path) -> None:
    frame = cloud(0)
    positions, masses = frame.positions.copy(), frame.optical_masses.copy()
    positions[3], masses[3] = 1e6, 0.0
    plan, _ = plan_of(tmp_path, [dataclasses.replace(frame, positions=positions, optical_masses=masses)], ExportConfig())
    assert plan.bounds[1][0] < 3.0


@pytest.mark.parametrize("frames", [[], [NOTHING, NOTHING]])
def test_an_asset_without_smoke(tmp_path: Path, frames: list[ParticleFrame]) -> None:
    plan, _ = plan_of(tmp_path, frames, ExportConfig())
    assert plan.voxel_size > 0
    assert plan.bounds == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@pytest.mark.skipif(vdb.openvdb_module() is None, reason="no OpenVDB module for this Python")
def test_files_are_numbered_from_one_and_those_that_exist_are_skipped(tmp_path: Path) -> None:
    folder = tmp_path / "vdb"
    with asset(tmp_path, [cloud(0), NOTHING, dataclasses.replace(cloud(2), ids=np.arange(400) + 1000)]) as particles:
        written = list(export.write_sequence(export.run(particles, ExportConfig(max_voxels=32), SilentReport()), folder))
        assert [path.name for _, path in written] == ["smoke_0001.vdb", "smoke_0002.vdb", "smoke_0003.vdb"]
        before = {path: path.read_bytes() for _, path in written}
        written[2][1].unlink()
        rest = export.run(particles, ExportConfig(max_voxels=32), SilentReport(), existing={0, 1})
        assert [frame for frame, _ in export.write_sequence(rest, folder)] == [2]
        part = export.run(particles, ExportConfig(max_voxels=32), SilentReport(), start=1, stop=2)
        assert [frame for frame, _ in export.write_sequence(part, tmp_path / "other")] == [1]
    # A resumed sequence, or a part of one, has the bytes of an undisturbed one.
    assert {path: path.read_bytes() for path in before} == before
    assert (tmp_path / "other" / "smoke_0002.vdb").read_bytes() == before[folder / "smoke_0002.vdb"]


def test_frames_that_are_not_there_and_a_cancel(tmp_path: Path) -> None:
    class Stopping(SilentReport):
        def progress(self, step: int, total: int, **metrics: float) -> None:
            raise Cancelled

    with asset(tmp_path, [cloud(0), cloud(1)]) as particles:
        for start, stop in ((0, 3), (-1, 1), (1, 1)):
            with pytest.raises(BackendError, match="no frames"):
                list(export.run(particles, ExportConfig(), SilentReport(), start=start, stop=stop))
        seen = export.run(particles, ExportConfig(), Stopping())
        next(seen)
        with pytest.raises(Cancelled):
            next(seen)
