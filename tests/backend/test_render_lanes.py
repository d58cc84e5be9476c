"""The vector operations, against numpy."""

from __future__ import annotations

import numpy as np
from numba import njit

from backend.render import lanes


@njit
def _exponentials(values, out):
    for k in range(0, values.size, lanes.LANES):
        lanes.store(out, k, lanes.exponential(lanes.load(values, k)))


@njit
def _interleave(values, out):
    lanes.store_interleaved(out, 0, lanes.load_stride2(values, 1), lanes.load_stride2(values, 0))


@njit
def _arithmetic(values, out):
    x = lanes.load(values, 0)
    lanes.store(out, 0, lanes.muladd(x, lanes.spread(np.float32(2)), lanes.ramp(np.float32(10))))
    lanes.store(out, 16, lanes.multiply(lanes.add(x, x), x))
    lanes.store(out, 32, lanes.flushed(x, np.float32(3)))
    return lanes.total(x)


def test_the_exponential_is_exact_to_float32_and_clamped_at_minus_30():
    values = np.concatenate([np.linspace(-30, 0, 64000), [-31.0, -88.0, -1e4, -3e38] * 4]).astype(np.float32)
    out = np.zeros_like(values)
    _exponentials(values, out)
    exact = np.exp(np.maximum(values.astype(np.float64), -30.0))
    assert np.abs(out / exact - 1).max() < 8e-7
    assert out[:64000].max() == 1.0


def test_interleaving_swaps_odd_and_even_and_keeps_the_rest():
    values = np.arange(32, dtype=np.float32)
    out = np.zeros(32, np.float32)
    _interleave(values, out)
    np.testing.assert_array_equal(out, values.reshape(16, 2)[:, ::-1].ravel())


def test_arithmetic_and_sum():
    values = (np.arange(16) - 7.5).astype(np.float32)
    out = np.zeros(48, np.float32)
    assert _arithmetic(values, out) == values.sum()
    np.testing.assert_array_equal(out[:16], 2 * values + 10 + np.arange(16))
    np.testing.assert_array_equal(out[16:32], 2 * values**2)
    np.testing.assert_array_equal(out[32:], np.where(np.abs(values) >= 3, values, 0))
