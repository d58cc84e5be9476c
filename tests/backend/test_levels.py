"""The network of levels: what it is shown of a clip, and what its answers make of proposals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from backend.fit import levelled
from backend.fit.levelled import OWN_ERROR, Levels, moved
from backend.fit.region import Pictures, Region
from backend.geometry.camera import View, view_at
from backend.prior.levels import NUM_FEATURES, LevelNet, ask, features_of, read_level_net
from backend.prior.network import PlumeNet
from backend.prior.predict import Prior, Proposal, read_weights, save_weights
from backend.prior.sheets import HEIGHT, NUM_LEVELS, NUM_MOMENTS, NUM_PARTS, UNIT, Sheets, look_at_sheets, moments_around
from backend.prior.window import SHAPE, away_of, stand_before
from synthetic.sweep import Orbit, orbit_cameras
from training.level_train import mirrored, reshaped

NUM_FRAMES = 60
VOXEL = 0.4
SOURCE = np.array([0.3, -0.2, 1.0])
ORBIT = Orbit(target=(0.0, 0.0, 8.0), distance=400.0, half_height=10.0, elevation=0.0, azimuth_start=-120.0, azimuth_stop=-60.0)
CAMERAS = orbit_cameras(ORBIT, width=60, height=50, fps=15.0, num_frames=NUM_FRAMES)
LEAN = np.array([0.15, 0.3])  # m a metre of height
STILL, ASKED, NEARBY, DRIFT = 0, 9, 13, 14  # of the features


def view(frame: int) -> View:
    return view_at(CAMERAS, frame)


def leaning(view_of: Callable[[int], View] = view) -> Callable[[int], np.ndarray]:
    """A thin column that leans from the source and never moves, as each frame shows it."""

    def depth_at(frame: int) -> np.ndarray:
        own = view_of(frame)
        image = np.zeros((own.height, own.width), np.float32)
        heights = np.linspace(1.2, 14.0, 400)
        points = np.column_stack([SOURCE[:2] + (heights - SOURCE[2])[:, None] * LEAN, heights])
        pixels, _ = own.project(points)
        columns = np.arange(own.width) + 0.5
        for column, row in pixels:
            image[int(row)] += 0.05 * np.exp(-0.5 * np.square((columns - column) / 2.0))
        return image

    return depth_at


def sheets_of(
    depth_at: Callable[[int], np.ndarray],
    view_of: Callable[[int], View] = view,
    *,
    source: np.ndarray = SOURCE,
    size: float = 1.0,
) -> Sheets:
    frames = moments_around(30, stride=2, num_frames=NUM_FRAMES)
    return look_at_sheets(depth_at, view_of, source, frames, height=8.0 * size, voxel_size=VOXEL * size, stride=2)


def as_lesson(sheets: Sheets) -> dict[str, torch.Tensor]:
    names = ("profile", "turns", "clues")
    part = {name: torch.from_numpy(getattr(sheets, name))[None] for name in names}
    return part | {"mass": part["profile"], "middle": torch.zeros_like(part["profile"]), "width": part["profile"].sum(-1)}


def seen(part: dict[str, torch.Tensor]) -> np.ndarray:
    return features_of(part["profile"], part["turns"], part["clues"])[0][0].numpy()


def behind(sheets: Sheets, lean: np.ndarray) -> np.ndarray:
    """[T, Z] units: how far behind the source a column lies that leans so."""
    frames = moments_around(30, stride=2, num_frames=NUM_FRAMES)
    away = np.stack([away_of(view(int(frame)))[:2] for frame in frames])
    return (away @ lean)[:, None] * (sheets.heights - SOURCE[2]) / (UNIT * VOXEL)


def test_a_still_level_is_found_where_it_is() -> None:
    sheets = sheets_of(leaning())
    found, truth = seen(as_lesson(sheets)), behind(sheets, LEAN)
    asked = found[ASKED] > 0
    assert found.shape == (NUM_FEATURES, NUM_MOMENTS, NUM_LEVELS)
    assert asked.mean() > 0.4
    assert np.abs(truth[asked]).max() > 1.5
    np.testing.assert_allclose(found[STILL][asked], truth[asked], atol=0.125)
    for held_back in (NEARBY, DRIFT):  # by few moments, or where part of it may be drift
        assert np.corrcoef(found[held_back][asked], truth[asked])[0, 1] > 0.9


def test_metres_are_not_known() -> None:
    def larger(frame: int) -> View:
        matrix = view(frame).camera_to_world.copy()
        matrix[:3, 3] *= 1000.0
        return replace(view(frame), camera_to_world=matrix)

    ours, theirs = sheets_of(leaning()), sheets_of(leaning(), larger, source=1000.0 * SOURCE, size=1000.0)
    np.testing.assert_allclose(seen(as_lesson(ours)), seen(as_lesson(theirs)), atol=1e-3)


def test_a_mirror_shows_what_lessons_in_a_mirror_show() -> None:
    """Left and right exchanged in the world is what a training makes of a lesson."""
    flip = np.diag([-1.0, 1.0, 1.0])
    source = SOURCE * (-1.0, 1.0, 1.0)

    def turned(frame: int) -> View:
        own = view(frame)
        matrix = own.camera_to_world.copy()
        matrix[:3, :3] = flip @ matrix[:3, :3] @ flip
        matrix[:3, 3] = flip @ matrix[:3, 3]
        return replace(own, camera_to_world=matrix)

    there = as_lesson(sheets_of(lambda frame: leaning()(frame)[:, ::-1], turned, source=source))
    here = mirrored(as_lesson(sheets_of(leaning())))
    for name in ("profile", "turns", "clues"):
        np.testing.assert_allclose(here[name], there[name], atol=1e-4)


def test_a_sheared_lesson_is_one_of_smoke_that_leans_more(monkeypatch: pytest.MonkeyPatch) -> None:
    sheets = sheets_of(leaning())
    monkeypatch.setattr(torch, "rand", lambda *size: torch.zeros(size))  # every clip
    draws = iter([torch.zeros(1, 2), torch.tensor([[0.1, -0.2]]) / 0.05, torch.zeros(1, 2), torch.zeros(1)])  # a lean, no more
    monkeypatch.setattr(torch, "randn", lambda *_: next(draws))
    part = reshaped(as_lesson(sheets))
    frames = moments_around(30, stride=2, num_frames=NUM_FRAMES)
    away = away_of(view(int(frames[NUM_MOMENTS // 2])))
    right = np.cross(away, [0.0, 0.0, 1.0])
    found, truth = seen(part), behind(sheets, LEAN + 0.1 * right[:2] - 0.2 * away[:2])
    asked = (found[ASKED] > 0) & (found[3] > 0.99)  # at every moment
    assert asked.sum() > 300
    np.testing.assert_allclose(found[STILL][asked], truth[asked], atol=0.15)
    told = part["middle"][0].numpy()[part["mass"][0].numpy() > 1e-3]
    assert np.ptp(told) > 0.5
    lean = (part["middle"] * part["mass"]).sum(-1)[0] / part["mass"].sum(-1)[0].clamp_min(1e-6)
    np.testing.assert_allclose(lean.numpy()[asked], (truth - behind(sheets, LEAN))[asked], atol=0.02)
    assert (4 * sheets.clues[HEIGHT, 0] >= -1).all()


def test_a_widened_lesson_is_one_of_wider_smoke(monkeypatch: pytest.MonkeyPatch) -> None:
    sheets = sheets_of(leaning())
    monkeypatch.setattr(torch, "rand", lambda *size: torch.zeros(size))
    draws = iter([torch.zeros(1, 2), torch.zeros(1, 2), torch.zeros(1, 2), torch.full((1,), float(np.log(1.3) / 0.12))])
    monkeypatch.setattr(torch, "randn", lambda *_: next(draws))
    before = as_lesson(sheets)
    before["middle"] += 0.2
    part = reshaped(before)
    here, there = seen(before), seen(part)
    asked = (here[ASKED] > 0) & (there[ASKED] > 0) & (np.abs(here[4]) < 1.5)
    np.testing.assert_allclose(there[4][asked], 1.3 * here[4][asked], atol=0.02)
    np.testing.assert_allclose(part["middle"][part["mass"] > 1e-3], 0.26, atol=1e-4)
    np.testing.assert_allclose(part["width"] - before["width"], np.log(1.3), rtol=1e-4)
    np.testing.assert_allclose(part["mass"].sum(-1)[0].numpy()[asked], before["mass"].sum(-1)[0].numpy()[asked], rtol=0.05)


@pytest.mark.parametrize(("frame", "first", "last"), [(0, 0, 60), (100, 70, 130), (199, 139, 199)])
def test_moments_lie_around_a_frame_and_within_the_clip(frame: int, first: int, last: int) -> None:
    frames = moments_around(frame, stride=2, num_frames=200)
    assert (frames[0], frames[-1]) == (first, last)
    assert (np.diff(frames) >= 0).all()
    assert set(moments_around(0, stride=3, num_frames=1)) == {0}


def test_what_is_said_has_a_place_for_every_part() -> None:
    middle, width, unsure, asked = ask(LevelNet(16), sheets_of(leaning()))
    assert middle.shape == (NUM_MOMENTS, NUM_LEVELS, NUM_PARTS)
    assert width.shape == unsure.shape == asked.shape == (NUM_MOMENTS, NUM_LEVELS)
    assert (width > 0).all()
    assert (unsure > 0).all()


def test_columns_of_a_grid_are_told_in_voxels() -> None:
    """All smoke a unit behind the source, a unit deep, and that is sure to two voxels."""
    levels = Levels(region(leaning()), Sure(float(np.log(2.0 / UNIT))), stride=2)
    for finer in (1.0, 1.5):
        stand = upright_column(9.0, finer=finer).stand
        told = levels.told(stand, 30)
        assert told.middle.shape == (stand.lattice.shape[0], stand.lattice.shape[2])
        np.testing.assert_allclose(told.middle, stand.voxels(SOURCE[None])[0, 1] / finer + UNIT, atol=1e-6)
        np.testing.assert_allclose(told.width, UNIT * np.exp(1.0), rtol=1e-6)
        np.testing.assert_allclose(told.unsure, 2.0, rtol=1e-6)
        assert told.asked.min() == 0.0
        assert told.asked.max() == 1.0


def test_levels_may_be_told_to_go_all_the_way() -> None:
    levels = Levels(region(leaning()), Sure(-6.0), stride=2)
    before = upright_column(9.0)
    whole = levels.levelled(before, 30)
    levels.share = 0.0
    np.testing.assert_allclose(middles(levels.levelled(before, 30).density), middles(before.density), atol=1e-4)
    np.testing.assert_array_equal(levels.levelled(before, 30, share=1.0).density, whole.density)


def region(depth_at: Callable[[int], np.ndarray]) -> Region:
    depths = [depth_at(frame) for frame in range(NUM_FRAMES)]
    views = tuple(view(frame) for frame in range(NUM_FRAMES))
    centre = np.array([0.0, 0.0, 8.0])
    pictures = Pictures(depths=depths, views=views)  # type: ignore[arg-type]
    return Region(pictures=pictures, fineness=1.0, finer=pictures, centre=centre, source=SOURCE, voxel_size=VOXEL)


def upright_column(at: float, *, finer: float = 1.0) -> Proposal:
    """Of one width, `at` of the prior's voxels along the view; on voxels `finer` times as fine."""
    width, depth, height = (round(finer * size) for size in SHAPE)
    stand = stand_before(view(30), np.array([0.0, 0.0, 8.0]), voxel_size=VOXEL / finer, shape=(width, depth, height))
    x, y, _ = (np.indices((width, depth, height)) + 0.5) / finer - 0.5
    density = np.exp(-0.5 * (np.square(x - 12) + np.square(y - at)) / 4).astype(np.float32)
    return Proposal(stand=stand, density=density, velocity=np.stack([density] * 3, axis=-1))


def middles(density: np.ndarray) -> np.ndarray:
    return np.einsum("xyz,y->z", density, np.arange(density.shape[1])) / density.sum(axis=(0, 1))


class Sure(LevelNet):
    """Says that all smoke is a unit behind the source, and how unsure that is."""

    def __init__(self, unsure: float) -> None:
        super().__init__(16)
        self.unsure = unsure

    def forward(self, features: torch.Tensor, asked: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        one = torch.ones(*asked.shape)
        return one[..., None].expand(*asked.shape, NUM_PARTS), one, one * self.unsure


@pytest.mark.parametrize(
    ("unsure", "least", "most"), [(-6.0, 0.97, 1.0), (float(np.log(OWN_ERROR / UNIT)), 0.48, 0.51), (4.0, 0.0, 0.01)]
)
def test_levels_go_the_further_the_surer_they_are(unsure: float, least: float, most: float) -> None:
    proposal = upright_column(9.0)
    found = Levels(region(leaning()), Sure(unsure), stride=2).levelled(proposal, 30)
    aim = float(proposal.stand.voxels(SOURCE[None])[0, 1]) + UNIT
    share = (middles(found.density) - 9.0)[8:28] / (aim - 9.0)
    assert (share > least).all()
    assert (share < most + 1e-3).all()
    assert found.density.sum() == pytest.approx(float(proposal.density.sum()), rel=0.01)
    assert found.density.dtype == found.velocity.dtype == np.float32


@pytest.mark.parametrize("finer", [1.0, 1.5, 2.0])
def test_levels_on_finer_voxels_go_as_far(finer: float) -> None:
    levels = Levels(region(leaning()), Sure(float(np.log(OWN_ERROR / UNIT))), stride=2)
    levels.weigh([(upright_column(9.0), 30)])
    share = levels.share
    levels.weigh([(upright_column(9.0, finer=finer), 30)])
    assert levels.share == pytest.approx(share, abs=0.02)
    before = upright_column(9.0, finer=finer)
    moves = (middles(levels.levelled(before, 30).density) - middles(before.density)) / finer
    coarse = upright_column(9.0)
    wanted = (middles(levels.levelled(coarse, 30).density) - middles(coarse.density))[8:28].mean()
    np.testing.assert_allclose(moves[round(8 * finer) : round(28 * finer)], wanted, atol=0.05)


@pytest.mark.parametrize(("usual", "least", "most"), [(0.7, 0.9, 1.0), (1.0, 0.48, 0.52), (1.5, 0.0, 0.05)])
def test_levels_go_where_the_clip_says_if_the_large_network_has_lost_its_way(
    monkeypatch: pytest.MonkeyPatch, usual: float, least: float, most: float
) -> None:
    """usual: times as far as the two are apart here."""
    proposal = upright_column(9.0)
    levels = Levels(region(leaning()), Sure(-6.0), stride=2)
    aim = float(proposal.stand.voxels(SOURCE[None])[0, 1]) + UNIT
    monkeypatch.setattr(levelled, "USUAL", usual * abs(aim - 9.0))
    levels.weigh([(proposal, 20), (proposal, 30)])
    share = (middles(levels.levelled(proposal, 30).density) - 9.0)[8:28] / (aim - 9.0)
    assert levels.share == pytest.approx(1.0 / (1.0 + usual**8), abs=0.02)
    assert (share > least).all()
    assert (share < most + 1e-3).all()


def test_of_a_black_clip_nothing_moves() -> None:
    proposal = upright_column(9.0)
    black = Levels(region(lambda _: np.zeros((50, 60), np.float32)), Sure(-6.0), stride=2)
    assert black.levelled(proposal, 30).density is proposal.density
    black.weigh([(proposal, 30)])
    assert black.share == 0.0
    nothing = replace(proposal, density=np.zeros(SHAPE, np.float32))
    assert not Levels(region(leaning()), Sure(-6.0), stride=2).levelled(nothing, 30).density.any()


def test_what_leaves_the_grid_is_lost_and_velocities_go_on() -> None:
    values = np.ones((2, 5, 3), np.float32)
    shift = np.array([0.0, 2.5, -7.0])
    assert moved(values, shift).sum(axis=(0, 1)).tolist() == [10.0, 5.0, 0.0]
    assert (moved(values, shift, outside="nearest") == 1.0).all()


def test_both_networks_survive_being_written(tmp_path) -> None:
    torch.manual_seed(1)
    net, levels = PlumeNet((8, 8, 8)), LevelNet(16)
    with open(tmp_path / "both.npz", "wb") as file:
        save_weights(net, file, levels)
    with open(tmp_path / "one.npz", "wb") as file:
        save_weights(net, file)
    assert read_level_net(tmp_path / "one.npz") is None
    assert Prior(tmp_path / "one.npz").levels is None
    again = read_level_net(tmp_path / "both.npz")
    assert again is not None
    sheets = sheets_of(leaning())
    for ours, theirs in zip(ask(levels, sheets), ask(again, sheets), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-2)
    kept, read = net.state_dict(), read_weights(tmp_path / "both.npz")[1]
    assert kept.keys() == read.keys()
    for name, values in kept.items():
        np.testing.assert_allclose(values, read[name], rtol=3e-3, atol=1e-6)
