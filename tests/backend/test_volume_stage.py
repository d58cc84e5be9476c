"""The stage that asks the prior: upright worlds, resume, nothing to see."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from backend.contract.cameras import Cameras
from backend.field.rays import optical_depth
from backend.fit.between import between
from backend.fit.guide import Guide
from backend.fit.region import FINER
from backend.fit.scene import make_scene, turned_about
from backend.fit.sharpen import SHARPNESS, sharpened
from backend.fit.state import VolumeRecord
from backend.geometry.camera import view_at
from backend.prior.levels import LevelNet
from backend.prior.network import PlumeNet
from backend.prior.predict import Prior, Proposal, save_weights
from backend.prior.shares import ShareNet
from backend.prior.window import SHAPE, Stand, stand_before
from backend.reporting import SilentReport
from backend.stages import volume
from benchmarks.tilted_scene import tilted, turn
from synthetic.sweep import Orbit, orbit_cameras, still_cameras

NUM_FRAMES = 6
ORBIT = Orbit(azimuth_stop=-85.0)
CAMERAS = orbit_cameras(ORBIT, width=72, height=128, fps=15.0, num_frames=NUM_FRAMES)


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> Prior:
    """Of random weights: what is tested here is what stands around it."""
    torch.manual_seed(1)
    net = PlumeNet((16, 16, 16))
    for part in (net.first, net.second):
        torch.nn.init.normal_(part.exit.weight, std=0.2)
    file = io.BytesIO()
    shares = ShareNet((8, 8, 8))
    torch.nn.init.normal_(shares.exit.weight, std=0.5)
    save_weights(net, file, LevelNet(16), shares)
    path: Path = tmp_path_factory.mktemp("prior") / "weights.npz"
    path.write_bytes(file.getvalue())
    return Prior(path)


def proposed(prior: Prior, *, every: int = 1, stride: int = 0, cameras: Cameras = CAMERAS, **more: Any) -> list[VolumeRecord]:
    """What the prior says of the asked frames."""
    plan = volume.make_plan(layers(), cameras, stride=stride, every=every)
    assert plan is not None
    return list(volume.propose(plan, SilentReport(), prior=prior, **{"done": [], **more}))


def volumes(
    prior: Prior, *, every: int = 1, stride: int = 0, cameras: Cameras = CAMERAS, num_workers: int = 0
) -> list[VolumeRecord]:
    """The whole stage."""
    plan = volume.make_plan(layers(), cameras, stride=stride, every=every)
    assert plan is not None
    report, shared = SilentReport(), {"prior": prior, "num_workers": num_workers}
    plan = volume.centred(plan, report, **shared)
    proposals = list(volume.propose(plan, report, done=[], **shared))
    return list(volume.run(plan, report, proposals, levels=prior.levels, shares=prior.shares))


def layers() -> list[np.ndarray]:
    """A column of puffs that rises."""
    found = []
    for frame in range(NUM_FRAMES):
        opacity = np.zeros((128, 72), np.float32)
        for height in np.linspace(2.0, 14.0, 20):
            pixel, _ = view_at(CAMERAS, frame).project(np.array([[0.1 * height, 0.0, height + 0.1 * frame]]))
            cv2.circle(opacity, (int(pixel[0, 0]), int(pixel[0, 1])), 6, 0.5, -1)
        opacity = cv2.GaussianBlur(opacity, (0, 0), 2.0)
        found.append(np.repeat(opacity[..., None], 4, axis=2))
    return found


def test_a_tilted_world_gets_the_same_answer_tilted(prior: Prior) -> None:
    tilt = turn(25.0)
    upright = volumes(prior)
    leaning = volumes(prior, cameras=tilted(CAMERAS, 25.0))
    points = np.random.default_rng(0).normal((0.5, 0.0, 8.0), 2.0, (300, 3))
    for a, b in zip(upright, leaning, strict=True):
        wanted, found = Guide(a), Guide(b)
        moved = points @ tilt[:3, :3].T
        largest = wanted.density.max()
        np.testing.assert_allclose(found.density_at(moved), wanted.density_at(points), atol=0.02 * largest)
        np.testing.assert_allclose(found.velocity_at(moved), wanted.velocity_at(points) @ tilt[:3, :3].T, atol=0.05)


@pytest.mark.parametrize(("every", "num_done"), [(1, 4), (2, 3), (3, 1), (3, 3), (16, 1)])
def test_it_goes_on_behind_what_is_done(prior: Prior, every: int, num_done: int) -> None:
    whole = proposed(prior, stride=16, every=every)
    rest = proposed(prior, stride=16, every=every, done=whole[:num_done])
    assert len(rest) == len(whole) - num_done
    for a, b in zip(whole[num_done:], rest, strict=True):
        assert a.density.tobytes() == b.density.tobytes()
        assert a.velocity.tobytes() == b.velocity.tobytes()


@pytest.mark.parametrize(("finer", "fineness"), [(False, 1.0), (True, FINER)])
def test_records_are_as_fine_as_wanted(prior: Prior, finer: bool, fineness: float) -> None:
    plan = volume.make_plan(layers(), CAMERAS, every=2, stride=16, finer=finer)
    assert plan is not None
    proposals = list(volume.propose(plan, SilentReport(), prior=prior, done=[]))
    records = list(volume.run(plan, SilentReport(), proposals, levels=prior.levels, shares=prior.shares))
    assert len(records) == NUM_FRAMES
    for record in [*proposals, *records]:
        assert record.density.shape == tuple(round(fineness * size) for size in SHAPE)
        assert float(record.voxel_size) == pytest.approx(plan.region.voxel_size / fineness)
    assert finer == (plan.region.finer.depths.shape != plan.region.pictures.depths.shape)


@pytest.mark.parametrize(("finer", "is_weighed"), [(False, False), (True, True)])
def test_shares_are_asked_on_finer_voxels_alone(prior: Prior, finer: bool, is_weighed: bool) -> None:
    """And of those only the densities differ by them."""
    plan = volume.make_plan(layers(), CAMERAS, every=2, stride=16, finer=finer)
    assert plan is not None
    proposals = list(volume.propose(plan, SilentReport(), prior=prior, done=[]))
    fixed, learned = (
        list(volume.run(plan, SilentReport(), proposals, levels=prior.levels, shares=shares)) for shares in (None, prior.shares)
    )
    for a, b in zip(fixed, learned, strict=True):
        assert (a.density.tobytes() != b.density.tobytes()) == is_weighed
        assert a.velocity.tobytes() == b.velocity.tobytes()
    without_levels = list(volume.run(plan, SilentReport(), proposals, levels=None, shares=prior.shares))
    with_nothing = list(volume.run(plan, SilentReport(), proposals, levels=None, shares=None))
    assert [a.density.tobytes() for a in without_levels] == [b.density.tobytes() for b in with_nothing]


def test_the_first_and_the_last_frame_are_asked_and_never_more_than_two_strides_apart() -> None:
    for every, stride, wanted in ((1, 16, range(6)), (2, 16, (0, 2, 4, 5)), (3, 1, (0, 2, 4, 5)), (16, 16, (0, 5))):
        plan = volume.make_plan(layers(), CAMERAS, stride=stride, every=every)
        assert plan is not None
        assert plan.asked == tuple(wanted)


def test_smoke_between_two_frames_is_where_it_was_on_its_way() -> None:
    view = view_at(CAMERAS, 0)
    stands = [stand_before(view, np.array([shift, 0.0, 8.0]), voxel_size=0.4, shape=SHAPE) for shift in (0.0, 0.3, -0.2)]
    velocity = np.array([2.0, -1.0, 3.0])

    def puff(stand: Stand, seconds: float) -> Proposal:
        points = (stand.lattice.centres() - stand.from_world[:3, 3]) @ stand.from_world[:3, :3]
        density = np.exp(-np.square(points - (np.array([0.1, 0.2, 7.5]) + seconds * velocity)).sum(axis=-1))
        return Proposal(
            stand=stand,
            density=density.astype(np.float32),
            velocity=np.broadcast_to(velocity, (*density.shape, 3)).astype(np.float32),
        )

    found = between(puff(stands[0], 0.0), puff(stands[1], 0.4), stands[2], share=0.25, seconds=0.4)
    wanted = puff(stands[2], 0.1)
    np.testing.assert_allclose(found.velocity, wanted.velocity, atol=1e-5)
    assert np.abs(found.density - wanted.density).max() < 0.06  # two trilinear lookups
    assert np.abs(puff(stands[2], 0.0).density - wanted.density).max() > 0.2


class Column(Prior):
    """Says that the smoke is a column at (x, y) m, whatever it is shown."""

    def __init__(self, x: float, y: float) -> None:
        self.foot, self.asked = np.array([x, y]), 0

    def propose(
        self, depth_at: Any, view_at: Any, centre: np.ndarray, source: Any, frame: int, *, voxel_size: float, **others: Any
    ) -> Proposal:
        self.asked += 1
        stand = stand_before(view_at(frame), centre, voxel_size=voxel_size, shape=SHAPE)
        density = np.exp(-np.square(stand.centres()[..., :2] - self.foot).sum(axis=-1)).astype(np.float32)
        return Proposal(stand=stand, density=density, velocity=np.zeros((*SHAPE, 3), np.float32))


@pytest.mark.parametrize(("y", "num_asked"), [(5.0, 4), (0.0, 2)])
def test_grids_go_to_where_the_prior_sees_smoke(y: float, num_asked: int) -> None:
    """Away from the camera, which the pictures say little about; they are asked again only where they have moved."""
    plan = volume.make_plan(layers(), CAMERAS)
    assert plan is not None
    prior = Column(0.6, y)
    found = volume.centred(plan, SilentReport(), prior=prior, num_workers=1)
    assert abs(plan.region.centre[1]) < 0.7
    assert abs(found.region.centre[1] - y) < 0.5
    assert found.region.centre[2] == plan.region.centre[2]
    assert prior.asked == num_asked


def test_a_prior_that_sees_nothing_moves_no_grid() -> None:
    plan = volume.make_plan(layers(), CAMERAS)
    assert plan is not None
    found = volume.centred(plan, SilentReport(), prior=Column(1e6, 0.0), num_workers=2)
    np.testing.assert_array_equal(found.region.centre, plan.region.centre)


def test_a_clip_without_smoke_has_no_volumes() -> None:
    empty = [np.zeros((128, 72, 4), np.float32)] * NUM_FRAMES
    assert volume.make_plan(empty, CAMERAS) is None


@pytest.mark.parametrize("num_workers", [2, 3, 50])
@pytest.mark.parametrize("every", [1, 2])
def test_frames_at_once_have_the_same_bytes_and_order(prior: Prior, num_workers: int, every: int) -> None:
    threads = torch.get_num_threads()
    alone, beside = (volumes(prior, stride=16, every=every, num_workers=count) for count in (1, num_workers))
    assert len(beside) == NUM_FRAMES
    for a, b in zip(alone, beside, strict=True):
        assert all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in ("density", "velocity", "from_world"))
    assert len({record.density.tobytes() for record in alone}) == NUM_FRAMES
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-7, 1.0, 1e5, 1e30])
def test_half_precision_does_for_values_of_any_size(size: float) -> None:
    values = (size * np.random.default_rng(0).normal(0.0, 1.0, (4, 5, 6, 3))).astype(np.float32)
    halved, unit = volume._halved(values)
    assert halved.dtype == np.float16
    np.testing.assert_allclose(halved * np.float32(unit), values, rtol=6e-4, atol=1e-7 * float(unit) * (size > 0))
    assert volume._halved(values[:0])[0].shape == (0, 5, 6, 3)


def test_a_guide_reads_records_in_their_own_units(prior: Prior) -> None:
    record = volumes(prior, stride=2)[0]
    assert record.density.dtype == record.velocity.dtype == np.float16
    whole = replace(
        record,
        density=record.density.astype(np.float32) * np.float32(record.density_unit),
        velocity=record.velocity.astype(np.float32) * np.float32(record.velocity_unit),
        density_unit=np.asarray(1.0),
        velocity_unit=np.asarray(1.0),
    )
    points = np.random.default_rng(0).normal((0.5, 0.0, 8.0), 2.0, (300, 3))
    assert Guide(whole).density_at(points).max() > 0.0
    np.testing.assert_array_equal(Guide(record).density_at(points), Guide(whole).density_at(points))
    np.testing.assert_array_equal(Guide(record).velocity_at(points), Guide(whole).velocity_at(points))


def test_how_far_a_camera_goes_around_the_smoke() -> None:
    scene = make_scene(layers(), CAMERAS)
    whole = np.radians(abs(ORBIT.azimuth_stop - ORBIT.azimuth_start))
    assert turned_about(scene.views, scene.anchor) == pytest.approx(whole * (NUM_FRAMES - 1) / NUM_FRAMES, rel=0.1)
    assert turned_about(scene.views[:1] * NUM_FRAMES, scene.anchor) == pytest.approx(0.0, abs=1e-6)


def test_before_a_still_camera_smoke_is_as_deep_as_wide_wherever_it_is_put(prior: Prior) -> None:
    still = still_cameras(ORBIT, turned=0.0, width=72, height=128, fps=15.0)
    still, view = replace(still, camera_to_world=still.camera_to_world * NUM_FRAMES), view_at(still, 0)
    report, spreads, shown = SilentReport(), {}, {}
    for as_wide in (False, True):
        plan = volume.make_plan(layers(), still, stride=1, every=1, as_wide=as_wide)
        assert plan is not None
        plan = volume.centred(plan, report, prior=prior)
        proposals = list(volume.propose(plan, report, prior=prior, done=[]))
        guide = Guide(list(volume.run(plan, report, proposals, levels=prior.levels, shares=prior.shares))[-1])
        along = (guide.stand.centres() @ view.camera_to_world[:3, 2]).ravel()
        spreads[as_wide] = float(np.sqrt(np.cov(along, aweights=guide.density.ravel())))
        shown[as_wide] = optical_depth(guide.density, guide.stand.lattice, guide.stand.seen(view))
    assert spreads[True] < 0.7 * spreads[False], "random weights say smoke everywhere"
    assert np.abs(shown[True] - shown[False]).max() < 0.15 * shown[False].max(), "the picture's sums along its rays"


def test_haze_goes_to_where_most_smoke_is() -> None:
    density = np.array([[[4.0, 1.0, 0.0]]], np.float32)
    everywhere = np.ones_like(density)
    ratio = sharpened(density, everywhere)[0, 0, 1] / sharpened(density, everywhere)[0, 0, 0]
    assert ratio == pytest.approx(0.25**SHARPNESS)
    there = sharpened(density, np.array([[[1.0, 9.0, 3.0]]], np.float32))
    assert there[0, 0, 1] > there[0, 0, 0]  # smoke was mostly at the second
    assert there[0, 0, 2] == 0.0
    nothing = np.zeros((2, 2, 2), np.float32)
    assert sharpened(nothing, nothing).max() == 0.0
    np.testing.assert_array_equal(sharpened(density, np.zeros_like(density)), density)


def test_the_rays_keep_what_the_frame_shows(prior: Prior) -> None:
    shown = layers()
    for frame, record in enumerate(volumes(prior)):
        guide, view = Guide(record), view_at(CAMERAS, frame)
        found = optical_depth(guide.density, guide.lattice, guide.stand.seen(view))
        wanted = -np.log1p(-np.minimum(shown[frame][..., 3], 0.996))
        blurred = [cv2.GaussianBlur(image.astype(np.float32), (0, 0), 3.0) for image in (found, wanted)]
        inside = blurred[1] > 0.3 * blurred[1].max()
        assert np.abs(blurred[0][inside] / blurred[1][inside] - 1.0).mean() < 0.15
