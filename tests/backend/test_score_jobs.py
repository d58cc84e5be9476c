"""What a job is scored on besides pictures: proposed volumes, the divergence of its motion, its buoyancy."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from backend.contract.errors import BackendError
from backend.contract.light import Light
from backend.contract.result import vdb_path
from backend.fit.state import VolumeRecord
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice
from backend.io.particles import ParticleFrame
from backend.io.vdb import write_vdb
from backend.render.picture import picture
from backend.render.voxelize import voxelize
from backend.score.exported import Exported, opacity_decibels
from backend.score.particles import learned_buoyancy, learned_light, mean_divergence
from backend.score.proposals import Proposals
from backend.score.truth_set import Volume


def truth_volume() -> Volume:
    return Volume(density=np.zeros((7, 9, 11)), velocity=None, voxel_size=0.2, origin=np.array([-0.4, 1.3, 2.0]))


def test_a_lattice_has_the_voxels_of_its_volume() -> None:
    like = truth_volume()
    centres = like.lattice.centres()
    assert centres.shape == (7, 9, 11, 3)
    assert np.allclose(centres[2, 0, 5], like.origin + 0.2 * np.array([2, 0, 5]))


def test_proposals_stand_where_their_grids_do() -> None:
    """A density linear in the world's x and z, on a grid that is turned by 30 degrees and moved: looked up it is itself."""
    c, s = np.cos(np.radians(30.0)), np.sin(np.radians(30.0))
    from_world = np.eye(4)
    from_world[:3, :3] = [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]
    from_world[:3, 3] = -from_world[:3, :3] @ np.array([0.2, 2.1, 3.0])
    size, shape = 0.25, (20, 22, 24)
    own = size * (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) - 0.5 * (np.array(shape) - 1))
    world = (own - from_world[:3, 3]) @ from_world[:3, :3]
    density = 10.0 + world[..., 0] + 2.0 * world[..., 2]
    velocity = np.broadcast_to(np.array([1.0, -2.0, 3.0]), (*shape, 3))
    record = VolumeRecord(
        density=(density / 4.0).astype(np.float32), velocity=velocity.astype(np.float32), from_world=from_world,
        voxel_size=np.asarray(size), density_unit=np.asarray(4.0),
    )  # fmt: skip
    like = truth_volume()
    wanted = like.lattice.centres()
    empty = VolumeRecord(
        density=np.zeros(shape, np.float32), velocity=np.zeros((*shape, 3), np.float32), from_world=from_world,
        voxel_size=np.asarray(size),
    )  # fmt: skip
    found, moves = Proposals([empty, record], frame_start=3).volume(like, 4)
    assert np.allclose(found, 10.0 + wanted[..., 0] + 2.0 * wanted[..., 2], atol=1e-4)
    assert np.allclose(moves, [1.0, -2.0, 3.0])
    far = Volume(density=np.zeros((2, 2, 2)), velocity=None, voxel_size=0.2, origin=np.full(3, 50.0))
    assert not Proposals([record], frame_start=0).volume(far, 0)[0].any()
    with pytest.raises(IndexError):
        Proposals([record], frame_start=0).volume(like, 1)


def test_exported_volumes_show_what_particles_show_unless_their_voxels_are_coarse(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    smoke = ParticleFrame(
        positions=random.normal(0.0, 0.6, (60, 3)).astype(np.float32), velocities=np.zeros((60, 3), np.float32),
        scales=np.full(60, 0.2, np.float32), optical_masses=np.full(60, 0.1, np.float32),
        colors=np.full((60, 3), 0.5, np.float32), ids=np.arange(60),
    )  # fmt: skip
    camera_to_world = np.diag([1.0, -1.0, -1.0, 1.0])
    camera_to_world[2, 3] = 9.0
    view = View(width=64, height=48, fx=90.0, fy=90.0, cx=32.0, cy=24.0, camera_to_world=camera_to_world)
    seen = picture(smoke, view)
    found = []
    for number, voxel_size in enumerate((0.15, 0.6)):
        count = round(6.0 / voxel_size)
        lattice = Lattice(origin=(-3.0, -3.0, -3.0), voxel_size=voxel_size, shape=(count, count, count))
        write_vdb(vdb_path(tmp_path, number), voxelize(smoke, lattice), voxel_size=voxel_size, origin=lattice.origin)
        opacity = Exported(tmp_path, frame_start=5).opacity(view, 5 + number)
        found.append(opacity_decibels(opacity, seen))
    assert found[0] > 38.0 and found[1] < found[0] - 8.0
    density = Exported(tmp_path, frame_start=0).density_at(lattice, 1)
    assert np.allclose(density, voxelize(smoke, lattice)["density"], atol=2e-3 * density.max())
    assert np.isnan(opacity_decibels(np.zeros((48, 64)), np.zeros((48, 64, 4))))
    with pytest.raises(BackendError, match="smoke_0004"):
        Exported(tmp_path, frame_start=0).opacity(view, 3)


def particles(*frames: ParticleFrame, radius: float = 0.5, buoyancy: tuple[float, ...] = (0.0, 0.0, 0.0)) -> SimpleNamespace:
    """As much of an open particles.h5 as is asked."""
    info = SimpleNamespace(fluid={"smoothing_length_m": radius}, buoyancy=buoyancy)
    return SimpleNamespace(info=info, num_frames=len(frames), frame=lambda index: frames[index])


def expanding(rate: float, count: int = 400) -> ParticleFrame:
    positions = np.random.default_rng(4).uniform(-1.0, 1.0, (count, 3))
    ones = np.ones(count, np.float32)
    return ParticleFrame(
        positions=positions, velocities=(rate * positions).astype(np.float32), scales=ones, optical_masses=ones,
        colors=np.ones((count, 3), np.float32), ids=np.arange(count),
    )  # fmt: skip


def test_divergence_of_an_even_expansion() -> None:
    """v = a x has div v = 3 a everywhere; the mean is over the frames that hold particles."""
    found = mean_divergence(particles(expanding(0.2), expanding(0.4), expanding(9.0, count=0)))  # type: ignore[arg-type]
    assert found["corrected"] == pytest.approx(0.9, rel=1e-3)
    assert 0.8 < found["as_published"] <= 0.9 and 0.9 < found["coverage"] <= 1.0


def test_what_no_frame_tells_is_left_out() -> None:
    assert mean_divergence(particles(expanding(1.0, count=0))) == {}  # type: ignore[arg-type]
    lonely = mean_divergence(particles(expanding(1.0, count=2)))  # type: ignore[arg-type]
    assert "corrected" not in lonely and lonely["coverage"] == 0.0


def test_the_direction_of_buoyancy() -> None:
    assert learned_buoyancy(particles(buoyancy=(0.0, 0.0, 2.0))) == {"strength": 2.0, "degrees_from_up": 0.0}  # type: ignore[arg-type]
    assert learned_buoyancy(particles(buoyancy=(3.0, 0.0, 3.0)))["degrees_from_up"] == pytest.approx(45.0)  # type: ignore[arg-type]
    assert learned_buoyancy(particles(buoyancy=(0.0, 0.0, -1.0)))["degrees_from_up"] == 180.0  # type: ignore[arg-type]
    assert learned_buoyancy(particles()) == {"strength": 0.0}  # type: ignore[arg-type]


def test_the_light_that_is_told() -> None:
    """Nothing where the smoke showed none."""
    light = Light(
        direction=(0.6, 0.0, 0.8), sun=(1.0, 0.9, 0.8), ambient=(0.0, 0.1, 0.2), softness=0.7, explained=0.75, doubt_degrees=9.0
    )
    told = learned_light(SimpleNamespace(info=SimpleNamespace(light=light)))  # type: ignore[arg-type]
    assert told == {"direction": [0.6, 0.0, 0.8], "explained": 0.75, "doubt_degrees": 9.0}
    assert learned_light(SimpleNamespace(info=SimpleNamespace(light=None))) == {}  # type: ignore[arg-type]
