"""Losses: hand values, gradients against torch's autograd and differences, the errors of the published formula, extremes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from backend.fit import losses


def pair(*, height: int = 23, width: int = 17, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return random.uniform(size=(3, height, width)), random.uniform(size=(3, height, width))


ALL = (losses.reconstruction, losses.l1, losses.structural_similarity, losses.frequency_as_published, losses.frequency)


@pytest.mark.parametrize("loss", ALL)
def test_gradients_are_differences(loss) -> None:
    picture, target = pair()
    _, gradient = loss(picture, target)
    direction = np.random.default_rng(1).normal(size=picture.shape)
    step = 1e-7
    slope = (loss(picture + step * direction, target)[0] - loss(picture - step * direction, target)[0]) / (2 * step)
    assert slope == pytest.approx(float(np.vdot(gradient, direction)), rel=1e-4, abs=1e-7)


def test_the_published_frequency_loss_is_torchs() -> None:
    picture, target = pair(seed=2)
    leaf = torch.tensor(picture, requires_grad=True)
    ours, theirs = torch.fft.fft2(leaf), torch.fft.fft2(torch.tensor(target))
    value = (ours.abs() - theirs.abs()).abs().mean() + (ours.angle() - theirs.angle()).abs().mean()
    value.backward()
    found, gradient = losses.frequency_as_published(picture, target)
    assert found == pytest.approx(float(value.detach()), rel=1e-10)
    assert leaf.grad is not None
    assert np.abs(gradient - leaf.grad.numpy()).max() < 1e-9 * np.abs(gradient).max()


def test_structural_similarity_is_scikit_images_inside() -> None:
    picture, target = pair(height=40, width=40, seed=3)
    inside = losses.structural_similarity(
        np.pad(picture, ((0, 0), (20, 20), (20, 20))), np.pad(target, ((0, 0), (20, 20), (20, 20)))
    )
    kwargs = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0, "channel_axis": 0}
    wide = [np.pad(values, ((0, 0), (20, 20), (20, 20))) for values in (picture, target)]
    assert inside[0] == pytest.approx(structural_similarity(*wide, full=True, **kwargs)[1].mean(), abs=1e-6)


def test_equal_pictures_lose_nothing_and_pull_nowhere() -> None:
    picture, _ = pair(seed=4)
    for loss in (losses.l1, losses.frequency, losses.frequency_as_published):
        value, gradient = loss(picture, picture)
        assert value == 0.0 and not gradient.any()
    value, gradient = losses.structural_similarity(picture, picture)
    assert value == pytest.approx(1.0) and np.abs(gradient).max() < 1e-12
    assert losses.reconstruction(picture, picture)[0] == pytest.approx(0.0, abs=1e-12)


def test_l1_by_hand() -> None:
    value, gradient = losses.l1(np.array([[[1.0, 3.0]]]), np.array([[[2.0, 1.0]]]))
    assert value == 1.5 and gradient.tolist() == [[[-0.5, 0.5]]]


def wave(phase: float, *, amplitude: float = 1.0, size: int = 32) -> np.ndarray:
    x = np.arange(size)
    return np.tile(amplitude * np.cos(2 * np.pi * 8 * x / size + phase), (1, size, 1))


def test_a_small_turn_is_small_only_when_corrected() -> None:
    """Phases of 3.1 and -3.1 differ by 0.08, not by 6.2."""
    one, other = wave(3.1), wave(-3.1)
    near = losses.frequency(one, other)[0]
    far = losses.frequency(wave(0.0), wave(np.pi))[0]
    assert near < 0.05 * far
    turned = np.abs(np.angle(np.fft.fft2(one)[0, 0, 8]) - np.angle(np.fft.fft2(other)[0, 0, 8]))
    assert turned > 6.0  # what the published formula counts


def test_the_corrected_value_does_not_grow_with_the_picture() -> None:
    """White noise: equal at four times the pixels; the published amplitude doubles."""
    values = {size: pair(height=size, width=size, seed=5) for size in (32, 64)}
    small, large = (losses.frequency(*values[size])[0] for size in (32, 64))
    assert large == pytest.approx(small, rel=0.1)
    amplitudes = [np.abs(np.abs(np.fft.fft2(values[size][0])) - np.abs(np.fft.fft2(values[size][1]))).mean() for size in (32, 64)]
    assert amplitudes[1] == pytest.approx(2 * amplitudes[0], rel=0.15)


def test_the_band_is_kept() -> None:
    slow = np.tile(np.cos(2 * np.pi * np.arange(32) / 32), (1, 32, 1))
    assert losses.frequency(slow, 0 * slow)[0] < 1e-12
    assert losses.frequency(slow, 0 * slow, band=(0.0, 0.1))[0] > 0.1
    with pytest.raises(ValueError, match="no frequency"):
        losses.frequency(slow, slow, band=(0.49999, 0.49999))


@pytest.mark.parametrize("shape", [(3, 1, 1), (1, 2, 5), (3, 8, 1)])
@pytest.mark.parametrize("values", ["zero", "random", "huge"])
def test_extremes_stay_finite(shape: tuple[int, int, int], values: str) -> None:
    random = np.random.default_rng(6)
    scale = {"zero": 0.0, "random": 1.0, "huge": 1e12}[values]
    picture, target = scale * random.uniform(size=shape), scale * random.uniform(size=shape)
    for loss in (losses.reconstruction, losses.frequency_as_published):
        value, gradient = loss(picture, target)
        assert np.isfinite(value) and np.isfinite(gradient).all()


def test_what_does_not_fit_is_refused() -> None:
    for loss in ALL:
        with pytest.raises(ValueError, match="cannot be compared"):
            loss(np.zeros((3, 4, 4)), np.zeros((3, 4, 5)))


def test_warm_up_is_linear() -> None:
    assert [losses.warm_up(i, 4) for i in (0, 1, 4, 9)] == [0.0, 0.25, 1.0, 1.0]
    assert losses.warm_up(0, 0) == 1.0
