"""From optical depth to opacity and colour."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from backend.render.composite import composite, composite_backward

DEPTHS = np.concatenate([[0.0, 1e-38, 1e-30, 1e-12], np.geomspace(1e-9, 50, 60), [1e3, 1e6, 1e30]])


def image_of(depths: np.ndarray, dtype: type) -> np.ndarray:
    """[4, 1, N]: smoke of colour 0.2, 0.5, 0.9."""
    return (depths * np.array([1.0, 0.2, 0.5, 0.9])[:, None])[:, None, :].astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_smoke_of_one_colour_keeps_it_at_every_depth(dtype):
    colour, opacity = composite(image_of(DEPTHS, dtype))
    tau = DEPTHS.astype(dtype).astype(np.float64)
    np.testing.assert_allclose(opacity[0], -np.expm1(-tau), rtol=2e-6)
    np.testing.assert_allclose(colour[1, 0], 0.5 * -np.expm1(-tau), rtol=2e-6, atol=1e-44)


def test_by_hand():
    colour, opacity = composite(np.array([2.0, 1.0])[:, None, None])
    assert opacity[0, 0] == pytest.approx(0.8646647168)
    assert colour[0, 0, 0] == pytest.approx(0.5 * 0.8646647168)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_gradient_is_that_of_autograd_in_the_safe_range_and_finite_everywhere(dtype):
    random = np.random.default_rng(0)
    grad_colour, grad_opacity = random.normal(size=(3, 1, len(DEPTHS))), random.normal(size=(1, len(DEPTHS)))
    image = image_of(DEPTHS, dtype)
    found = composite_backward(image, grad_colour.astype(dtype), grad_opacity.astype(dtype))
    assert found.dtype == dtype
    assert np.isfinite(found).all()
    x = torch.tensor(image.astype(np.float64), requires_grad=True)
    loss = (x[1:] * (-torch.expm1(-x[0]) / x[0]) * torch.tensor(grad_colour)).sum() - (
        torch.expm1(-x[0]) * torch.tensor(grad_opacity)
    ).sum()
    loss.backward()
    assert x.grad is not None
    safe = (DEPTHS > 1e-4) & (DEPTHS < 1e20)
    np.testing.assert_allclose(found[..., safe], x.grad.numpy()[..., safe], rtol=1e-4, atol=1e-6)


def test_the_gradient_at_no_smoke():
    found = composite_backward(np.zeros((2, 1, 1)), np.full((1, 1, 1), 3.0), np.full((1, 1), 5.0))
    np.testing.assert_array_equal(found[:, 0, 0], [5.0, 3.0])


def test_a_missing_gradient_counts_as_zero():
    image = image_of(DEPTHS[:20], np.float64)
    zero, ones = np.zeros((1, 20)), np.ones((3, 1, 20))
    np.testing.assert_array_equal(composite_backward(image, ones, None), composite_backward(image, ones, zero))
    np.testing.assert_array_equal(composite_backward(image, None, zero), np.zeros_like(image))
