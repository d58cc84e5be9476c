"""Lessons of the network of shares, and its training."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from backend.field.rays import optical_depth
from backend.prior.levels import LevelNet, read_level_net
from backend.prior.network import PlumeNet
from backend.prior.predict import Prior, read_net, save_weights
from backend.prior.shares import NAMES, ShareNet, read_share_net
from training import share_lessons
from training.library import Plume
from training.share_train import Agreed, Moments, main, mirrored, picture_errors, score


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of random weights."""
    torch.manual_seed(1)
    path: Path = tmp_path_factory.mktemp("prior") / "weights.npz"
    with open(path, "wb") as file:
        save_weights(PlumeNet((8, 8, 8)), file, LevelNet(16))
    return path


@pytest.fixture(scope="module")
def lessons(recorded: Plume, prior: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One clip of one plume, under the names of eleven; what is known is nearly right, but not sharp."""
    folder = tmp_path_factory.mktemp("lessons")
    clip = share_lessons.draw_clip(recorded, np.random.default_rng(0), prior=Prior(prior))
    assert clip is not None
    clip["sharp"] = np.sqrt(clip["truth"])
    for number in range(11):
        np.savez(folder / f"{number:04d}_0.npz", **clip)  # type: ignore[arg-type]
    return folder


@pytest.fixture(scope="module")
def part(lessons: Path) -> dict[str, torch.Tensor]:
    return Moments([lessons / "0000_0.npz"]).batch([0, 1])


def test_the_picture_is_of_the_smoke_that_is_there(lessons: Path) -> None:
    moments = Moments([lessons / "0000_0.npz"])
    assert len(moments) >= 4
    for index in range(len(moments)):
        one = moments.batch([index])
        (stand,), ((picture, view),) = one["stands"], one["pictures"]
        shown = optical_depth(one["truth"][0].numpy(), stand.lattice, view)
        assert np.corrcoef(np.expm1(-shown).ravel(), np.expm1(-picture).ravel())[0, 1] > 0.9
        assert all(torch.isfinite(one[name]).all() for name in NAMES)


def test_the_same_number_draws_the_same_clip(recorded: Plume, prior: Path) -> None:
    a, b = (share_lessons.draw_clip(recorded, np.random.default_rng(0), prior=Prior(prior)) for _ in range(2))
    assert a is not None
    assert b is not None
    assert all(a[name].tobytes() == b[name].tobytes() for name in a)


def test_a_prior_without_levels_teaches_no_shares(recorded: Plume, tmp_path: Path) -> None:
    with open(tmp_path / "one.npz", "wb") as file:
        save_weights(PlumeNet((8, 8, 8)), file)
    with pytest.raises(ValueError, match="without a network of levels"):
        share_lessons.draw_clip(recorded, np.random.default_rng(0), prior=Prior(tmp_path / "one.npz"))


def test_what_agrees_with_a_picture_loses_on_a_ray_what_it_gains(part: dict[str, torch.Tensor]) -> None:
    """The gradient, against differences."""
    density = (part["truth"] + 0.1 * part["truth"].amax()).requires_grad_()
    deep = torch.linspace(-1.0, 1.0, density.shape[2])[:, None].expand(density.shape)
    (Agreed.apply(density, part["stands"], part["pictures"]) * deep).sum().backward()
    assert density.grad is not None
    way = density.detach() * deep
    with torch.no_grad():
        ends = [Agreed.apply(density + sign * way, part["stands"], part["pictures"]) for sign in (0.05, -0.05)]
    for own in range(2):
        measured = float(((ends[0] - ends[1])[own] * deep[own]).sum() / 0.1)
        assert measured > 0.0
        assert float((density.grad[own] * way[own]).sum()) == pytest.approx(measured, rel=0.1)


def test_a_mirror_shows_the_same(part: dict[str, torch.Tensor]) -> None:
    found, turned = (Agreed.apply(each["sharp"], each["stands"], each["pictures"]) for each in (part, mirrored(part)))
    torch.testing.assert_close(turned.flip(1), found, rtol=1e-3, atol=1e-4)
    twice = mirrored(mirrored(part))
    assert all(torch.equal(twice[name], part[name]) for name in (*NAMES, "truth"))


def test_pictures_from_aside_are_what_they_say() -> None:
    """A block that is deep is wide from aside; from where the camera stands both are alike."""
    thin, deep = torch.zeros(1, 16, 16, 8), torch.zeros(1, 16, 16, 8)
    thin[:, 6:10, 6:10] = 1.0
    deep[:, 6:10, 4:12] = 0.5
    size = torch.tensor([0.1])
    assert picture_errors(thin, deep, size, 0.0).item() < 1e-5
    aside = picture_errors(thin, deep, size, 90.0).item()
    assert aside > 1e-3
    assert picture_errors(thin, deep, size, -90.0).item() == pytest.approx(aside, rel=1e-3)
    assert picture_errors(thin, thin, size, 33.0).item() < 1e-5


def test_moments_that_are_nothing_like_the_truth_are_left_out(lessons: Path, tmp_path: Path) -> None:
    path = lessons / "0000_0.npz"
    whole = Moments([path])
    with np.load(path) as arrays:
        clip = dict(arrays)
    clip["sharp"] = clip["truth"].copy()
    clip["sharp"][1] = clip["truth"][1, ::-1, ::-1, ::-1]
    np.savez(tmp_path / "0000_0.npz", **clip)  # type: ignore[arg-type]
    assert len(Moments([tmp_path / "0000_0.npz"], least=0.78)) == len(whole) - 1
    assert len(Moments([tmp_path / "0000_0.npz"])) == len(whole)


def test_a_training_leaves_all_networks(lessons: Path, prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--lessons", lessons, "--beside", prior, "--out", tmp_path / "all.npz", "--steps", 20]
    assert main([str(argument) for argument in arguments]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["steps"] for line in lines] == list(range(0, 21, 2))
    assert lines[-1]["space"] < lines[0]["space"]
    net = read_share_net(tmp_path / "all.npz")
    assert net is not None
    assert read_level_net(tmp_path / "all.npz") is not None
    for ours, theirs in zip(read_net(tmp_path / "all.npz").parameters(), read_net(prior).parameters(), strict=True):
        torch.testing.assert_close(ours, theirs)
    moments = Moments([lessons / "0000_0.npz"])
    assert score(net, moments)["space"] < score(ShareNet(), moments)["space"]


def test_lessons_are_drawn_once(folder: Path, prior: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(share_lessons, "_prior", lambda: Prior(prior))
    target = tmp_path / "0000.npz"
    share_lessons.write_lessons(folder, target, seed=3, count=1)
    (made,) = tmp_path.glob("*.npz")
    before = made.read_bytes()
    made.unlink()
    share_lessons.write_lessons(folder, target, seed=3, count=1)  # the plume is known to be done
    assert not list(tmp_path.glob("*.npz"))
    (tmp_path / "0000.done").unlink()
    share_lessons.write_lessons(folder, target, seed=3, count=1)
    assert made.read_bytes() == before
