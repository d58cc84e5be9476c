"""The network of shares: what it is shown of a frame, and what its answers make of a density."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from backend.prior.levels import LevelNet, read_level_net
from backend.prior.network import PlumeNet
from backend.prior.predict import Prior, save_weights
from backend.prior.shares import NUM_FEATURES, Known, ShareNet, ask, features_of, read_share_net

SHAPE = 12, 12, 20
_UNITS = {"said": 1.0, "moved": 1.0, "lasts": 1.0, "sharp": 1.0}


def known(seed: int = 0) -> Known:
    draw = np.random.default_rng(seed)
    densities = {name: draw.gamma(0.5, 1.0, SHAPE).astype(np.float32) for name in _UNITS}
    return Known(
        **densities,
        depth=draw.gamma(1.0, 1.0, SHAPE).astype(np.float32),
        middle=draw.uniform(3, 9, (SHAPE[0], SHAPE[2])).astype(np.float32),
        width=draw.uniform(1, 4, SHAPE[2]).astype(np.float32),
        unsure=draw.uniform(0.5, 2, SHAPE[2]).astype(np.float32),
        asked=np.linspace(0, 1, SHAPE[2]).astype(np.float32),
        astray=np.asarray(1.5 + seed, np.float32),
    )


def batch(one: Known) -> dict[str, torch.Tensor]:
    return {field.name: torch.from_numpy(getattr(one, field.name))[None] for field in fields(Known)}


@pytest.fixture
def net() -> ShareNet:
    """Of random weights."""
    torch.manual_seed(2)
    net = ShareNet((8, 8, 16))
    torch.nn.init.normal_(net.exit.weight, std=0.5)
    return net.eval()


def test_untaught_it_leaves_all_as_it_is() -> None:
    one = known()
    np.testing.assert_array_equal(ask(ShareNet(), one), one.sharp)


def test_units_are_not_known(net: ShareNet) -> None:
    one = known()
    other = replace(one, **{name: np.float32(1000.0) * getattr(one, name) for name in _UNITS})
    np.testing.assert_allclose(features_of(batch(other)), features_of(batch(one)), atol=1e-4)
    np.testing.assert_allclose(ask(net, other), 1000.0 * ask(net, one), rtol=1e-2)


def test_every_clue_counts(net: ShareNet) -> None:
    one = known()
    seen = features_of(batch(one))
    assert seen.shape == (1, NUM_FEATURES, *SHAPE)
    assert np.abs(seen.numpy()).max() < 4.0
    for field in fields(Known):
        value = getattr(known(1), field.name)
        other = replace(one, **{field.name: value[..., ::-1].copy() if value.ndim else value})
        assert not np.allclose(ask(net, other) / other.sharp, ask(net, one) / one.sharp, rtol=1e-3), field.name


def test_levels_that_were_not_asked_have_no_say(net: ShareNet) -> None:
    one = replace(known(), asked=np.zeros(SHAPE[2], np.float32))
    other = replace(one, middle=one.middle + 2, width=2 * one.width, unsure=3 * one.unsure)
    np.testing.assert_array_equal(ask(net, one), ask(net, other))


def test_weights_are_bounded(net: ShareNet) -> None:
    torch.nn.init.normal_(net.exit.weight, std=1e3)
    one = known()
    weights = ask(net, one) / one.sharp
    assert weights.min() < 0.02
    assert weights.max() > 50.0
    assert (np.abs(np.log(weights)) < 4.001).all()


@pytest.mark.parametrize("value", [0.0, 1e-30, 1e30])
def test_nothing_and_very_much_stay_what_they_are(net: ShareNet, value: float) -> None:
    one = known()
    same = replace(one, **{name: np.full(SHAPE, value, np.float32) for name in _UNITS}, depth=np.zeros(SHAPE, np.float32))
    found = ask(net, same)
    assert np.isfinite(found).all()
    assert (found >= 0.0).all()
    assert (found.max() == 0.0) == (value == 0.0)


def test_all_networks_survive_being_written(net: ShareNet, tmp_path: Path) -> None:
    with open(tmp_path / "all.npz", "wb") as file:
        save_weights(PlumeNet((8, 8, 8)), file, LevelNet(16), net)
    with open(tmp_path / "two.npz", "wb") as file:
        save_weights(PlumeNet((8, 8, 8)), file, LevelNet(16))
    assert read_share_net(tmp_path / "two.npz") is None
    assert Prior(tmp_path / "two.npz").shares is None
    again = read_share_net(tmp_path / "all.npz")
    assert again is not None
    np.testing.assert_allclose(ask(again, known()), ask(net, known()), rtol=0.05)
    assert read_level_net(tmp_path / "all.npz") is not None
    assert Prior(tmp_path / "all.npz").shares is not None
