"""Smoothing kernels of particle fluids, compiled, float64.

Symbols: r distance between two particles [m], h smoothing length [m]. Both kernels vanish at and beyond r = h and
integrate to one over space. Mueller et al. 2003, "Particle-Based Fluid Simulation for Interactive Applications".

Numba caches a compiled function until its own file changes: after an edit here, remove __pycache__.
"""

from __future__ import annotations

import math

from numba import njit

POLY6 = 315.0 / (64.0 * math.pi)  # W(0) h^3 of poly6
SPIKY_SLOPE = 45.0 / math.pi  # -dW/dr(0) h^4 of spiky

# Integral over space of the squared gradient of spiky, times h^5:
# (45/pi)^2 4 pi int_0^1 (1 - q)^4 q^2 dq = (45/pi)^2 4 pi / 105.
SPIKY_SQUARED_GRADIENT = SPIKY_SLOPE * SPIKY_SLOPE * 4.0 * math.pi / 105.0


@njit(cache=True, inline="always")
def poly6(distance_squared, smoothing_length):
    """Poly6 kernel, Mueller 2003 eq. 20. r^2 [m^2], h [m] -> 1/m^3. Takes the square, so that no root is drawn."""
    if smoothing_length <= 0.0:
        return 0.0
    share = 1.0 - distance_squared / (smoothing_length * smoothing_length)
    if share <= 0.0:
        return 0.0
    return POLY6 * share * share * share / (smoothing_length * smoothing_length * smoothing_length)


@njit(cache=True, inline="always")
def spiky_slope(distance, smoothing_length):
    """dW/dr of the spiky kernel, Mueller 2003 eq. 21. r [m], h [m] -> 1/m^4, never positive.

    The gradient by a particle's position is this times the unit vector that points at it from its neighbour.
    """
    if smoothing_length <= 0.0:
        return 0.0
    share = 1.0 - distance / smoothing_length
    if share <= 0.0:
        return 0.0
    squared = smoothing_length * smoothing_length
    return -SPIKY_SLOPE * share * share / (squared * squared)
