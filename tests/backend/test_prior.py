"""The prior: where its grid stands, what it looks up, whom it follows, and that its weights survive being written."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from backend.field.rays import at_voxels
from backend.fit.guide import Guide
from backend.fit.state import VolumeRecord
from backend.geometry.camera import View, view_at
from backend.geometry.lattice import Lattice
from backend.prior.network import Conv, PlumeNet, Sight, folded, follow, seen_at, unfolded
from backend.prior.predict import Prior, save_weights
from backend.prior.window import OFFSETS, SHAPE, Window, look, stand_before
from synthetic.sweep import Orbit, orbit_cameras

SMALL = (16, 16, 16)
NUM_FRAMES = 40
ORBIT = Orbit(target=(0.0, 0.0, 8.0), distance=30.0, half_height=10.0)
CAMERAS = orbit_cameras(ORBIT, width=30, height=50, fps=15.0, num_frames=NUM_FRAMES)


def view(frame: int) -> View:
    return view_at(CAMERAS, frame)


def sight(window: Window) -> Sight:
    names = ("images", "matrices", "strides", "conditions", "source")
    sizes = torch.tensor([[30.0, 50.0]])
    return Sight(sizes=sizes, **{name: torch.from_numpy(getattr(window, name))[None] for name in names})


def window_at(frame: int, *, shape: tuple[int, int, int] = SMALL, stride: int = 1) -> Window:
    stand = stand_before(view(frame), np.array([0.3, -0.2, 8.0]), voxel_size=0.8, shape=shape)
    rng = np.random.default_rng(3)
    images = rng.random((NUM_FRAMES, 50, 30), dtype=np.float32)
    return look(lambda f: images[f], view, stand, np.array([0.0, 0.0, 2.0]), frame, stride=stride, num_frames=NUM_FRAMES)


def test_the_grid_stands_level_before_its_camera() -> None:
    stand = stand_before(view(7), np.array([1.0, 2.0, 3.0]), voxel_size=0.5, shape=SMALL)
    own = stand.seen(view(7)).camera_to_world
    np.testing.assert_allclose(own[2, 0], 0.0, atol=1e-12)  # the image's rows are level
    np.testing.assert_allclose(own[0, 2], 0.0, atol=1e-12)  # it looks along +y, a little down
    assert own[1, 2] > 0.9
    assert own[2, 2] == pytest.approx(-math.sin(math.radians(ORBIT.elevation)))
    np.testing.assert_allclose(stand.voxels(np.array([1.0, 2.0, 3.0])), 7.5, atol=1e-12)


@pytest.mark.parametrize(("outside", "beyond"), [("grid-constant", 0.0), ("nearest", 1.0)])
def test_values_of_the_outermost_voxels_do_not_hang_on_rounding(outside: str, beyond: float) -> None:
    """Grids that share a wall look each other's values up right on it."""
    stand = stand_before(view(7), np.array([1.0, 2.0, 3.0]), voxel_size=0.5, shape=SMALL)
    low = stand.centres().reshape(-1, 3)[0]
    inward = stand.centres().reshape(-1, 3)[-1] - low
    points = low + np.array([-1e-9, 0.0, 1e-9, -1.0])[:, None] * inward
    found = stand.at(np.ones(SMALL, np.float32), points, outside=outside)
    np.testing.assert_allclose(found, [1.0, 1.0, 1.0, beyond], atol=1e-6)


def test_lookups_agree_with_the_projection_of_views() -> None:
    """seen_at is the torch way to what backend.field.rays looks up voxel by voxel."""
    window = window_at(20)
    stand = stand_before(view(20), np.array([0.3, -0.2, 8.0]), voxel_size=0.8, shape=SMALL)
    axes = [torch.arange(size, dtype=torch.float32) for size in SMALL]
    voxels = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    found, inside = seen_at(sight(window), voxels.expand(1, len(OFFSETS), *SMALL, 3))
    for index, offset in enumerate(OFFSETS):
        frame = 20 + offset
        pixels, _ = stand.seen(view(frame)).project(stand.lattice.centres().reshape(-1, 3))
        is_inside = ((pixels > 0.6) & (pixels < (29.4, 49.4))).all(axis=1).reshape(SMALL)
        wanted = at_voxels(window.images[index], stand.lattice, stand.seen(view(frame)))
        assert is_inside.mean() > 0.5
        assert inside[0, index].numpy()[is_inside].all()
        np.testing.assert_allclose(found[0, index].numpy()[is_inside], wanted[is_inside], atol=2e-4)


def test_beyond_an_image_its_border_goes_on() -> None:
    window = window_at(20)
    whole = sight(window)
    cut = replace(whole, sizes=torch.tensor([[20.0, 50.0]]))  # as if the last ten columns had not been taken
    axes = [torch.arange(size, dtype=torch.float32) for size in SMALL]
    voxels = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).expand(1, len(OFFSETS), *SMALL, 3)
    (found, inside), (of_all, _) = seen_at(cut, voxels), seen_at(whole, voxels)
    repeated = whole.images.clone()
    repeated[..., 20:] = repeated[..., 19:20]
    wanted, _ = seen_at(replace(whole, images=repeated), voxels)
    torch.testing.assert_close(found, wanted, atol=1e-5, rtol=0)
    assert 0.2 < inside.mean() < 0.8
    is_well_inside = inside * (found == of_all) > 0
    assert is_well_inside.sum() > 0.9 * inside.sum()


def test_the_ends_of_a_clip_are_told() -> None:
    window = window_at(2, stride=3)
    assert window.strides.min() == pytest.approx(-2 / 3)
    assert window.strides.max() == pytest.approx(37 / 3)
    np.testing.assert_array_equal(window.images[0], window.images[5])  # both are frame 0, clamped
    empty = look(
        lambda f: np.zeros((50, 30), np.float32),
        view,
        stand_before(view(0), np.zeros(3), voxel_size=1.0, shape=SMALL),
        np.zeros(3),
        0,
        stride=1,
        num_frames=NUM_FRAMES,
    )
    assert empty.scale == 1.0
    assert np.isfinite(empty.images).all()


def test_smoke_is_followed_along_a_uniform_velocity() -> None:
    velocity = torch.zeros(1, 3, *SMALL)
    velocity[:, 0], velocity[:, 2] = 0.25, -0.5
    axes = [torch.arange(size, dtype=torch.float32) for size in SMALL]
    voxels = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    strides = torch.tensor([OFFSETS], dtype=torch.float32)
    strides[0, -1] = 11.0  # the clip ended
    paths = follow(velocity, voxels, strides)
    for index in range(len(OFFSETS)):
        wanted = voxels + strides[0, index] * torch.tensor([0.25, 0.0, -0.5])
        torch.testing.assert_close(paths[0, index], wanted, atol=1e-4, rtol=0)


def test_folding_is_undone_by_unfolding() -> None:
    x = torch.arange(2 * 3 * 4 * 6 * 8, dtype=torch.float32).reshape(2, 3, 4, 6, 8)
    assert folded(x).shape == (2, 24, 2, 3, 4)
    torch.testing.assert_close(unfolded(folded(x)), x)


def test_density_is_never_negative_and_none_where_the_frame_shows_none() -> None:
    torch.manual_seed(0)
    net = PlumeNet((16, 16, 16))
    for net_part in (net.first, net.second):
        torch.nn.init.normal_(net_part.exit.weight)
    window = window_at(20)
    window.images[OFFSETS.index(0), :, :12] = 0.0
    (_, _), (density, velocity) = net(sight(window), SMALL)
    assert density.shape == (1, *SMALL)
    assert velocity.shape == (1, 3, *SMALL)
    assert (density >= 0).all()
    assert torch.isfinite(velocity).all()
    assert density[0, :4].max() == 0.0  # the grid's left is the picture's left
    assert density[0, 12:].max() > 0.0


@pytest.mark.parametrize("size", [1, 3])
def test_a_convolution_answers_as_torch_s_own(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    layer = Conv(12, 8, size, padding=size // 2)
    window = torch.randn(1, 12, 6, 6, 10, generator=torch.Generator().manual_seed(0))
    window = window.contiguous(memory_format=torch.channels_last_3d)
    learned = layer(window)
    assert learned.requires_grad
    with torch.no_grad():
        found = layer(window)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            assert layer(window).dtype == torch.bfloat16
        monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
        without = layer(window)
    torch.testing.assert_close(found, without, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(found, learned.detach(), atol=1e-5, rtol=1e-5)


def test_weights_are_read_as_they_were_written_and_answers_do_not_depend_on_threads(tmp_path: Path) -> None:
    torch.manual_seed(0)
    net = PlumeNet((16, 16, 16))
    torch.nn.init.normal_(net.second.exit.weight)
    file = io.BytesIO()
    save_weights(net, file)
    (tmp_path / "weights.npz").write_bytes(file.getvalue())
    rng = np.random.default_rng(3)
    images = rng.random((NUM_FRAMES, 50, 30), dtype=np.float32)
    answers = []
    threads = torch.get_num_threads()
    for count in (1, 2):
        torch.set_num_threads(count)
        prior = Prior(tmp_path / "weights.npz")
        answers.append(
            prior.propose(
                lambda f: images[f],
                view,
                np.array([0.0, 0.0, 8.0]),
                np.array([0.0, 0.0, 2.0]),
                20,
                voxel_size=0.5,
                stride=2,
                num_frames=NUM_FRAMES,
                seconds_per_frame=1 / 15,
            )
        )
    torch.set_num_threads(threads)
    assert answers[0].density.shape == SHAPE
    assert answers[0].density.tobytes() == answers[1].density.tobytes()
    assert answers[0].velocity.tobytes() == answers[1].velocity.tobytes()


def test_a_proposal_is_looked_up_in_the_world() -> None:
    stand = stand_before(view(10), np.array([0.0, 0.0, 8.0]), voxel_size=0.5, shape=SHAPE)
    world = stand.lattice.centres() @ stand.from_world[:3, :3] - stand.from_world[:3, 3] @ stand.from_world[:3, :3]
    density = np.exp(-0.5 * np.square((world - (1.0, -0.5, 9.0)) / 1.2).sum(axis=-1)).astype(np.float32)
    guide = Guide(
        VolumeRecord(density=density, velocity=world.astype(np.float32), from_world=stand.from_world, voxel_size=np.asarray(0.5))
    )
    lattice = Lattice(origin=(-3.0, -3.0, 5.0), voxel_size=0.4, shape=(15, 15, 20))
    wanted = np.exp(-0.5 * np.square((lattice.centres() - (1.0, -0.5, 9.0)) / 1.2).sum(axis=-1))
    points = lattice.centres().reshape(-1, 3)
    np.testing.assert_allclose(guide.density_at(points), wanted.ravel(), atol=0.06)
    np.testing.assert_allclose(guide.velocity_at(points), points, atol=1e-4)
