"""Smoothing kernels: hand values, integrals, support, and the derivative against finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numba import njit

from backend.physics.kernels import POLY6, SPIKY_SQUARED_GRADIENT, poly6, spiky_slope
from tests.reference import fluid_loops


@njit
def _shell_sums(length, num):
    """Integrals over space by shells (midpoint rule): of poly6, of r times the spiky slope, of the slope squared."""
    mass, slope_moment, squares = 0.0, 0.0, 0.0
    width = length / num
    for k in range(num):
        r = (k + 0.5) * width
        volume = 4.0 * math.pi * r * r * width
        mass += poly6(r * r, length) * volume
        slope_moment += r * spiky_slope(r, length) * volume
        squares += spiky_slope(r, length) ** 2 * volume
    return mass, slope_moment, squares


def test_hand_values():
    assert poly6(0.0, 1.0) == pytest.approx(315.0 / (64.0 * math.pi), rel=1e-15)
    assert poly6(0.25, 1.0) == pytest.approx(315.0 / (64.0 * math.pi) * 27.0 / 64.0, rel=1e-15)
    assert spiky_slope(0.5, 1.0) == pytest.approx(-45.0 / math.pi * 0.25, rel=1e-15)
    assert poly6(1.0, 2.0) == pytest.approx(POLY6 * 27.0 / 64.0 / 8.0, rel=1e-15)
    assert spiky_slope(1.0, 2.0) == pytest.approx(-45.0 / math.pi * 0.25 / 16.0, rel=1e-15)


@pytest.mark.parametrize("length", [1e-3, 0.37, 1.0, 1e3])
def test_integrals(length):
    """Both are normalised. Integration by parts: the volume integral of r dW/dr is -3 times that of W."""
    mass, slope_moment, squares = _shell_sums(length, 20_000)
    assert mass == pytest.approx(1.0, rel=1e-6)
    assert slope_moment == pytest.approx(-3.0, rel=1e-6)
    assert squares == pytest.approx(SPIKY_SQUARED_GRADIENT / length**5, rel=1e-6)


def test_zero_at_and_beyond_the_support():
    assert poly6(1.0, 1.0) == 0.0 and poly6(1.5, 1.0) == 0.0 and poly6(1e300, 1.0) == 0.0
    assert spiky_slope(1.0, 1.0) == 0.0 and spiky_slope(2.0, 1.0) == 0.0
    assert poly6(0.0, 0.0) == 0.0 and spiky_slope(0.0, 0.0) == 0.0


def test_against_the_printed_formulas():
    for distance in np.linspace(0.01, 1.2, 40):
        assert poly6(distance * distance, 0.9) == pytest.approx(fluid_loops.poly6(distance, 0.9), rel=1e-12, abs=1e-15)
        gradient = fluid_loops.spiky_gradient(np.array([distance, 0.0, 0.0]), 0.9)
        assert spiky_slope(distance, 0.9) == pytest.approx(gradient[0], rel=1e-12, abs=1e-15)
