"""Lessons of the network of levels, and its training."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from backend.prior.levels import LevelNet, read_level_net
from backend.prior.network import PlumeNet
from backend.prior.predict import read_net, save_weights
from backend.prior.shares import ShareNet, read_share_net
from backend.prior.sheets import HEIGHT, NUM_LEVELS, NUM_MOMENTS, NUM_PARTS, parts
from training.level_lessons import draw_clip, write_lessons
from training.level_train import Clips, main, mixed
from training.library import Plume


def clips_of(recorded: Plume, count: int) -> list[dict[str, np.ndarray]]:
    drawn = [draw_clip(recorded, np.random.default_rng(number)) for number in range(count)]
    return [clip for clip in drawn if clip is not None]


def test_what_is_shown_is_the_smoke_that_is_there(recorded: Plume) -> None:
    """On a sheet through the source, from a camera that looks down a little; where the picture shows all of the smoke."""
    likeness = []
    for clip in clips_of(recorded, 12):
        shown, real = (np.square(clip[name] / 255.0) for name in ("profile", "mass"))
        assert shown.shape == real.shape == (NUM_MOMENTS, NUM_LEVELS, NUM_PARTS)
        likeness.append(np.corrcoef(shown.ravel(), real.ravel())[0, 1])
    assert len(likeness) > 8
    assert np.median(likeness) > 0.85


def test_the_plume_leans_the_same_way_from_every_side(recorded: Plume) -> None:
    """By a voxel in ten of height, across the view and along it together, whatever the camera's way."""
    leans = []
    for clip in clips_of(recorded, 6):
        mass = np.square(clip["mass"] / 255.0)
        level = mass.sum(axis=-1)
        heights = 4 * clip["clues"][HEIGHT, 0].astype(float)
        for row in np.flatnonzero(level.max(axis=1) > 0.5 * level.max()):
            places = np.stack([(mass[row] @ parts()), (mass[row] * clip["middle"][row]).sum(axis=-1)], axis=1)
            counted = level[row] > 0.3 * level[row].max()
            if np.ptp(heights[counted]) > 2.0:
                slope = np.polyfit(heights[counted], (places / np.maximum(level[row], 1e-9)[:, None])[counted], 1)[0]
                leans.append(np.linalg.norm(slope))
    assert len(leans) > 20
    np.testing.assert_allclose(leans, 0.1, atol=0.03)


def test_the_same_number_draws_the_same_clip(recorded: Plume) -> None:
    a, b = (clips_of(recorded, 1)[0] for _ in range(2))
    assert all(a[name].tobytes() == b[name].tobytes() for name in a)


def test_a_training_leaves_all_networks(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "lessons").mkdir()
    write_lessons(folder, tmp_path / "lessons" / "0000.npz", seed=3, count=4)
    for number in range(1, 7):
        shutil.copy(tmp_path / "lessons" / "0000.npz", tmp_path / "lessons" / f"{number:04d}.npz")
    assert len(Clips([tmp_path / "lessons" / "0000.npz"])) == 4
    large = PlumeNet((8, 8, 8))
    with open(tmp_path / "large.npz", "wb") as file:
        save_weights(large, file, shares=ShareNet())
    arguments = ["--lessons", tmp_path / "lessons", "--beside", tmp_path / "large.npz", "--out", tmp_path / "both.npz"]
    threads = torch.get_num_threads()
    assert main([str(argument) for argument in [*arguments, "--steps", 40, "--channels", 16]]) == 0
    assert torch.get_num_threads() == threads
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(lines) == 20
    assert lines[-1]["taught"][0] < lines[0]["taught"][0]
    assert read_level_net(tmp_path / "both.npz") is not None
    assert read_share_net(tmp_path / "both.npz") is not None
    for ours, theirs in zip(read_net(tmp_path / "both.npz").parameters(), large.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=3e-3, atol=1e-6)


def test_weights_that_ship_may_lie_between_those_before_and_those_learned() -> None:
    start, learned = LevelNet(8), LevelNet(8)
    half = mixed(start, learned, 0.5)
    for weight, before, after in zip(half.parameters(), start.parameters(), learned.parameters(), strict=True):
        torch.testing.assert_close(weight, 0.5 * (before + after))
    for weight, after in zip(mixed(start, learned, 1.0).parameters(), learned.parameters(), strict=True):
        torch.testing.assert_close(weight, after)
