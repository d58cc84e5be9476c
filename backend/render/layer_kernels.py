"""Drawing splats over one another, front to back, and its adjoint: the inner loops of the coloured mode.

Splats come in order of depth. In a cell that light T of what is behind reaches, splat i with optical depth tau_i = A_i w_i

    adds  T (1 - exp(-tau_i)) c_i  to the colour,  and leaves  T exp(-tau_i).

With S_i = sum of c_ik times the gradient of colour k, and R_i = what the loss owes to all that is behind splat i, the
gradient with respect to tau_i is S_i T exp(-tau_i) - R_i. R_i is the cell's total less the part up to i, so that the adjoint
goes front to back as well and divides by nothing. A band is drawn by one thread; see splat_kernels.py.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from .binning import BAND_ROWS
from .lanes import LANES, absorbed, add, exponential, load, muladd, multiply, ramp, spread, store, total
from .splat_kernels import NUM_SUMS, place_of, row_of


@njit(cache=True, parallel=True)
def draw_layers(buffer, pyramid, bins, splats, boxes, amplitudes, features, num_tasks):
    """Writes all bands of buffer (flat, one level): channel 0 the light that passes, channel 1 + k colour k.

    amplitudes [N] float32, features [N, K] float32, nearest splat first.
    """
    num_features = features.shape[1]
    for task in prange(num_tasks):
        for k in range(task, bins.order.shape[0], num_tasks):
            band = bins.order[k]
            start, plane, stride, num_columns, first_row, stop_row = place_of(pyramid, bins, band, 1 + num_features)
            for c in range(1 + num_features):
                value = np.float32(0) if c else np.float32(1)
                buffer[start + c * plane + first_row * stride : start + c * plane + stop_row * stride] = value
            for e in range(bins.band_starts[band], bins.band_starts[band + 1]):
                i = bins.pair_splats[e]
                if amplitudes[i] == np.float32(0):
                    continue
                u, v, a, b, s = splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 3], splats[i, 4]
                slope, strength = spread(np.float32(-0.5 * a)), spread(amplitudes[i])
                minus, step = spread(np.float32(-1)), spread(np.float32(LANES))
                for row in range(max(first_row, boxes[i, 0]), min(stop_row, boxes[i, 1] + 1)):
                    first, count, t0, exponent, _ = row_of(u, v, a, b, s, boxes[i, 2], boxes[i, 3], row, num_columns)
                    t, peak = ramp(t0), spread(exponent)
                    at = start + row * stride + first
                    for place in range(at, at + count, LANES):
                        depth = multiply(exponential(muladd(multiply(t, t), slope, peak)), strength)
                        light = load(buffer, place)
                        taken = multiply(light, absorbed(depth))
                        store(buffer, place, muladd(taken, minus, light))
                        for c in range(num_features):
                            tinted = place + (c + 1) * plane
                            store(buffer, tinted, muladd(taken, spread(features[i, c]), load(buffer, tinted)))
                        t = add(t, step)


@njit(cache=True, parallel=True)
def differentiate_layers(gradient, pyramid, bins, splats, boxes, amplitudes, features, num_tasks, slots):
    """Adjoint of draw_layers: slots [P, NUM_SUMS + K] float32.

    gradient: flat, one level; channel 0 the cell's total (sum of the gradients times the results, opacity's with the sign of
    the light that passes), channel 1 + k the gradient of colour k. A slot holds the six sums of splat_kernels.py with g the
    gradient of the splat's optical depth, then the gradients of its features.
    """
    num_features = features.shape[1]
    zero = np.float32(0)
    for task in prange(num_tasks):
        scratch = np.empty(LANES * (1 + num_features), np.float32)
        passing = np.empty(BAND_ROWS * pyramid.strides[0], np.float32)
        spent = np.empty(BAND_ROWS * pyramid.strides[0], np.float32)
        for k in range(task, bins.order.shape[0], num_tasks):
            band = bins.order[k]
            start, plane, stride, num_columns, first_row, stop_row = place_of(pyramid, bins, band, 1 + num_features)
            passing[:] = np.float32(1)
            spent[:] = zero
            for e in range(bins.band_starts[band], bins.band_starts[band + 1]):
                i, slot = bins.pair_splats[e], bins.pair_slots[e]
                low, high = max(first_row, boxes[i, 0]), min(stop_row, boxes[i, 1] + 1)
                _differentiate_one(
                    gradient, start, plane, stride, num_columns, first_row, low, high, splats, boxes, i, amplitudes[i], features,
                    passing, spent, scratch, slots, slot,
                )  # fmt: skip


@njit(cache=True, forceinline=True)
def _differentiate_one(
    gradient, start, plane, stride, num_columns, band_row, first_row, stop_row, splats, boxes, i, amplitude, features,
    passing, spent, scratch, slots, slot,
):  # fmt: skip
    u, v, a, b, s = splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 3], splats[i, 4]
    num_features = features.shape[1]
    zero, minus = spread(np.float32(0)), spread(np.float32(-1))
    slope, strength, step = spread(np.float32(-0.5 * a)), spread(amplitude), spread(np.float32(LANES))
    s0, s1, s2, y1, y2, x1 = zero, zero, zero, zero, zero, zero
    for c in range(num_features):
        store(scratch, c * LANES, zero)
    for row in range(first_row, stop_row):
        first, count, t0, exponent, dy = row_of(u, v, a, b, s, boxes[i, 2], boxes[i, 3], row, num_columns)
        t, peak = ramp(t0), spread(exponent)
        r0, r1, r2 = zero, zero, zero
        shift = start + band_row * stride
        at = start + row * stride + first
        for place in range(at, at + count, LANES):
            own = place - shift
            square = multiply(t, t)
            weight = exponential(muladd(square, slope, peak))
            light = load(passing, own)
            taken = multiply(light, absorbed(multiply(weight, strength)))
            left = muladd(taken, minus, light)
            value = zero
            for c in range(num_features):
                g_c = load(gradient, place + (c + 1) * plane)
                value = muladd(spread(features[i, c]), g_c, value)
                store(scratch, c * LANES, muladd(taken, g_c, load(scratch, c * LANES)))
            paid = muladd(taken, value, load(spent, own))
            store(spent, own, paid)
            store(passing, own, left)
            behind = muladd(paid, minus, load(gradient, place))
            weighted = multiply(weight, muladd(behind, minus, multiply(value, left)))
            r0 = add(r0, weighted)
            r1 = muladd(weighted, t, r1)
            r2 = muladd(weighted, square, r2)
            t = add(t, step)
        height = spread(dy)
        s0, s1, s2 = add(s0, r0), add(s1, r1), add(s2, r2)
        r0 = multiply(r0, height)
        y1 = add(y1, r0)
        y2 = muladd(r0, height, y2)
        x1 = muladd(r1, height, x1)
    slots[slot, 0], slots[slot, 1], slots[slot, 2] = total(s0), total(s1), total(s2)
    slots[slot, 3], slots[slot, 4], slots[slot, 5] = total(y1), total(y2), total(x1)
    for c in range(num_features):
        slots[slot, NUM_SUMS + c] = total(load(scratch, c * LANES))
