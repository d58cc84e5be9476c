"""Lessons: what is drawn, how it is mirrored, and that a net with more inputs can take over the weights of one with fewer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from made_plumes import grid, made_plume

from backend.prior.network import PlumeNet, Sight, seen_at
from backend.prior.window import OFFSETS, SHAPE
from training.lessons import write_lessons
from training.library import VOXEL_SIZE, Plume
from training.plumes import plume
from training.samples import draw_lesson
from training.train import Lessons, bounded, take_over


def test_pictures_have_many_sizes_and_nothing_beyond_them(recorded: Plume) -> None:
    sizes = set()
    for number in range(6):
        lesson = draw_lesson(recorded, np.random.default_rng(number))
        width, height = lesson.size
        sizes.add((int(width), int(height)))
        images = lesson.window.images
        assert images.shape == (len(OFFSETS), 96, 56)
        assert images[:, :height, :width].max() > 0.0
        assert not images[:, height:].any()
        assert not images[:, :, width:].any()
        assert lesson.density.shape == SHAPE
        assert lesson.density.min() >= 0.0
    assert len(sizes) > 3


def test_grids_stand_around_the_smoke(recorded: Plume) -> None:
    """As a fit's do once the prior has moved them, give or take what it misses by."""
    found = []
    for number in range(24):
        mass = draw_lesson(recorded, np.random.default_rng(number)).density.sum(axis=2)
        found.append(np.array([mass.sum(axis=1) @ np.arange(SHAPE[0]), mass.sum(axis=0) @ np.arange(SHAPE[1])]) / mass.sum())
    off = np.abs(np.array(found) - 11.5)
    assert np.median(off) < 2.0
    assert off.max() > 2.0


def test_clips_are_short_and_long(recorded: Plume) -> None:
    """Of a short clip a window sees less than it could, and compares pictures that are closer in time."""
    spans = [float(np.ptp(draw_lesson(recorded, np.random.default_rng(number)).window.strides)) for number in range(20)]
    assert min(spans) < 12.0 and max(spans) > 18.0
    assert min(spans) >= 4.0, "four strides at least: what the fit itself sees to"


def test_the_source_is_found_in_the_pictures(recorded: Plume) -> None:
    """As a fit finds it: where the pictures show the foot of the smoke, whatever the scene says of its sources."""
    count = 0
    for number in range(16):
        lesson = draw_lesson(recorded, np.random.default_rng(number))
        window, (width, height) = lesson.window, lesson.size.astype(int)
        if np.ptp(window.conditions[len(OFFSETS) : 2 * len(OFFSETS)]) == 0.0:
            continue  # a camera that stands still: nothing tells how far away it is
        x, y, w = window.matrices[OFFSETS.index(0)] @ [*window.source, 1.0]
        column, row = round(float(x / w)), round(float(y / w))
        image = np.where(window.images[OFFSETS.index(0)] > 0.2, 1, 0)[:height, :width]
        lowest = int(np.flatnonzero(image.any(axis=1))[-1])
        assert abs(row - lowest) < 6
        assert image[max(0, lowest - 4) : lowest + 1, max(0, column - 5) : column + 6].any()
        count += 1
    assert count > 8


def test_a_grid_before_a_still_camera_tells_nothing_of_depth() -> None:
    """It stands where smoke is taken to rise, give or take, as a fit's does, wherever the smoke went from there."""
    x, y, z = grid()
    blown = made_plume(100 * np.exp(-((x - 30) ** 2 + (y - 30) ** 2) / 20 - (z - 18) ** 2 / 80))
    beyond = np.array([blown.origin[axis] + VOXEL_SIZE * 30 for axis in (0, 1)])
    assert np.linalg.norm(beyond - np.mean([item.position[:2] for item in blown.scene.sources], axis=0)) > 4.0
    across, along = [], []
    for number in range(60):
        window = draw_lesson(blown, np.random.default_rng(number)).window
        if np.ptp(window.conditions[len(OFFSETS) : 2 * len(OFFSETS)]) == 0.0:
            across.append(abs(window.source[0] - 11.5))
            along.append(abs(window.source[1] - 11.5))
    assert len(along) > 5
    assert np.mean(along) < 4.0 < np.mean(across)


def test_the_same_number_draws_the_same_lesson_and_scene(recorded: Plume) -> None:
    a, b = (draw_lesson(recorded, np.random.default_rng(4)) for _ in range(2))
    assert a.density.tobytes() == b.density.tobytes()
    assert plume(230) == plume(230)
    wind = [np.hypot(*plume(seed).wind[:2]) for seed in range(260)]
    assert np.mean(wind[200:]) > 1.3 * np.mean(wind[:200])  # the later ones are windier


def test_a_mirrored_lesson_is_what_a_mirror_shows(folder: Path, tmp_path: Path) -> None:
    write_lessons(folder, tmp_path / "0003.npz", seed=3, count=2)
    lessons = Lessons([tmp_path / "0003.npz"])
    plain, density, velocity = lessons.batch(torch.tensor([0, 1]), mirrored=False)
    turned, turned_density, turned_velocity = lessons.batch(torch.tensor([0, 1]), mirrored=True)
    torch.testing.assert_close(turned_density, density.flip(1))
    torch.testing.assert_close(turned_velocity[:, 0], -velocity[:, 0].flip(1))
    torch.testing.assert_close(turned_velocity[:, 2], velocity[:, 2].flip(1))
    axes = [torch.arange(size, dtype=torch.float32) for size in SHAPE]
    voxels = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).expand(2, len(OFFSETS), *SHAPE, 3)
    for ours, theirs in zip(seen_at(turned, voxels), seen_at(plain, voxels), strict=True):
        assert (ours - theirs.flip(2)).abs().mean() < 1e-3
    assert isinstance(turned, Sight)


def test_inputs_that_a_net_did_not_have_have_no_say_at_first(folder: Path, tmp_path: Path) -> None:
    write_lessons(folder, tmp_path / "0003.npz", seed=3, count=1)
    sight, _, _ = Lessons([tmp_path / "0003.npz"]).batch(torch.tensor([0]), mirrored=False)
    torch.manual_seed(0)
    old, new = PlumeNet((16, 16, 16)), PlumeNet((16, 16, 16))
    for part in (old.first, old.second):
        torch.nn.init.normal_(part.exit.weight)
        with torch.no_grad():
            part.entry.weight[:, -8:] = 0.0  # the last input: whether the picture shows a place
    fewer = {name: weight[:, :-8] if name.endswith("entry.weight") else weight for name, weight in old.state_dict().items()}
    take_over(new, fewer)
    with torch.no_grad():
        for ours, theirs in zip(new(sight, SHAPE)[1], old(sight, SHAPE)[1], strict=True):
            torch.testing.assert_close(ours, theirs)


def test_a_lesson_that_cannot_be_solved_does_not_outweigh_the_others() -> None:
    small, huge = bounded(torch.tensor([0.3])), bounded(torch.tensor([1e4]))
    torch.testing.assert_close(small, torch.tensor([0.3]), rtol=0.01, atol=0.0)
    assert huge < 10 * small
