"""Drawing splats into bands of rows, and its adjoint: the inner loops, sixteen cells at a time.

A band is drawn by one thread, its splats in order of index, so that every sum has one order and no two threads write to
one place. In the adjoint each pair of splat and band writes its own slot; `gather` adds up a splat's slots.

The weight of splat i in cell (x, y) is w = exp(-b dy^2 / 2 - a t^2 / 2), dy = y - v, t = x - u - s dy (projection.py).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from .binning import BAND_ROWS
from .lanes import LANES, add, exponential, load, muladd, multiply, ramp, spread, store, total
from .projection import CUT

NUM_SUMS = 6  # of w g (S0), w g t (S1), w g t^2 (S2), w g dy (Y1), w g dy^2 (Y2), w g t dy (X)


@njit(cache=True, inline="always")
def _span(splat, row, num_columns):
    """First cell of a row, count of cells rounded up to LANES (0: none), x of the row's centre, exponent there, dy."""
    dy = row - splat[1]
    exponent = -0.5 * splat[3] * dy * dy
    centre = splat[0] + splat[4] * dy
    room = CUT + exponent
    if room <= 0.0:
        return 0, 0, centre, exponent, dy
    half = math.sqrt(2.0 * room / splat[2])
    low = max(centre - half, 0.0)
    high = min(centre + half, num_columns - 1.0)
    if low > high:
        return 0, 0, centre, exponent, dy
    first = math.ceil(low)
    return first, (math.floor(high) - first + LANES) // LANES * LANES, centre, exponent, dy


@njit(cache=True, parallel=True)
def draw(buffer, num_channels, rows, columns, strides, offsets, band_levels, band_rows, band_starts, pair_splats, splats,
         amplitudes, features, order, num_tasks):  # fmt: skip
    """Writes all bands of buffer (flat, see pyramid.py): channel 0 sum of A w, channel 1 + k sum of A w c_k.

    amplitudes [N] float32, features [N, num_channels - 1] float32. order: the bands, dealt to num_tasks tasks.
    """
    for task in prange(num_tasks):
        for k in range(task, order.shape[0], num_tasks):
            band = order[k]
            level = band_levels[band]
            stride, num_columns = strides[level], columns[level]
            plane = rows[level] * stride
            start = num_channels * offsets[level]
            first_row = band_rows[band]
            stop_row = min(first_row + BAND_ROWS, rows[level])
            for c in range(num_channels):
                buffer[start + c * plane + first_row * stride : start + c * plane + stop_row * stride] = np.float32(0)
            for e in range(band_starts[band], band_starts[band + 1]):
                i = pair_splats[e]
                if amplitudes[i] != np.float32(0):
                    _draw_one(
                        buffer, start, plane, stride, num_columns, first_row, stop_row, splats[i], amplitudes[i], features[i]
                    )


@njit(cache=True)
def _draw_one(buffer, start, plane, stride, num_columns, first_row, stop_row, splat, amplitude, feature):
    slope = spread(np.float32(-0.5 * splat[2]))
    step = spread(np.float32(LANES))
    strength = spread(amplitude)
    reach = math.sqrt(2.0 * CUT / splat[3])
    low = max(first_row, math.ceil(max(splat[1] - reach, 0.0)))
    high = min(stop_row - 1, math.floor(min(splat[1] + reach, 1e9)))
    for row in range(low, high + 1):
        first, count, centre, exponent, _ = _span(splat, row, num_columns)
        at = start + row * stride + first
        t = ramp(np.float32(first - centre))
        peak = spread(np.float32(exponent))
        for k in range(0, count, LANES):
            weight = multiply(exponential(muladd(multiply(t, t), slope, peak)), strength)
            store(buffer, at + k, add(load(buffer, at + k), weight))
            for c in range(feature.shape[0]):
                place = at + k + (c + 1) * plane
                store(buffer, place, muladd(weight, spread(feature[c]), load(buffer, place)))
            t = add(t, step)


@njit(cache=True, parallel=True)
def differentiate(gradient, num_channels, rows, strides, columns, offsets, band_levels, band_rows, band_starts, pair_splats,
                  pair_slots, splats, features, order, num_tasks, slots):  # fmt: skip
    """Adjoint of draw: slots [P, NUM_SUMS + num_channels - 1] float32, sums over the pair's cells of unit-amplitude terms.

    With g = gradient of channel 0 plus sum of c_k times that of channel 1 + k: the six sums, then sum of w g_k for each k.
    """
    for task in prange(num_tasks):
        for k in range(task, order.shape[0], num_tasks):
            band = order[k]
            level = band_levels[band]
            start = num_channels * offsets[level]
            stop_row = min(band_rows[band] + BAND_ROWS, rows[level])
            plane = rows[level] * strides[level]
            for e in range(band_starts[band], band_starts[band + 1]):
                i = pair_splats[e]
                slot = slots[pair_slots[e]]
                _differentiate_one(
                    gradient,
                    start,
                    strides[level],
                    columns[level],
                    plane,
                    band_rows[band],
                    stop_row,
                    splats[i],
                    features[i],
                    slot,
                )


@njit(cache=True)
def _differentiate_one(gradient, start, stride, num_columns, plane, first_row, stop_row, splat, feature, slot):
    zero = spread(np.float32(0))
    slope = spread(np.float32(-0.5 * splat[2]))
    step = spread(np.float32(LANES))
    s0, s1, s2, y1, y2, x1 = zero, zero, zero, zero, zero, zero
    for c in range(feature.shape[0]):
        slot[NUM_SUMS + c] = np.float32(0)
    reach = math.sqrt(2.0 * CUT / splat[3])
    low = max(first_row, math.ceil(max(splat[1] - reach, 0.0)))
    high = min(stop_row - 1, math.floor(min(splat[1] + reach, 1e9)))
    for row in range(low, high + 1):
        first, count, centre, exponent, dy = _span(splat, row, num_columns)
        at = start + row * stride + first
        t = ramp(np.float32(first - centre))
        peak = spread(np.float32(exponent))
        r0, r1, r2 = zero, zero, zero
        for k in range(0, count, LANES):
            square = multiply(t, t)
            weight = exponential(muladd(square, slope, peak))
            g = load(gradient, at + k)
            for c in range(feature.shape[0]):
                g_c = load(gradient, at + k + (c + 1) * plane)
                g = muladd(spread(feature[c]), g_c, g)
                slot[NUM_SUMS + c] += total(multiply(weight, g_c))
            weighted = multiply(weight, g)
            r0 = add(r0, weighted)
            r1 = muladd(weighted, t, r1)
            r2 = muladd(weighted, square, r2)
            t = add(t, step)
        height = spread(np.float32(dy))
        s0, s1, s2 = add(s0, r0), add(s1, r1), add(s2, r2)
        r0 = multiply(r0, height)
        y1 = add(y1, r0)
        y2 = muladd(r0, height, y2)
        x1 = muladd(r1, height, x1)
    slot[0], slot[1], slot[2], slot[3], slot[4], slot[5] = total(s0), total(s1), total(s2), total(y1), total(y2), total(x1)


@njit(cache=True, parallel=True)
def weigh(gradient, rows, strides, columns, offsets, band_levels, band_rows, band_starts, pair_splats, pair_slots, splats,
          order, num_tasks, slots):  # fmt: skip
    """As differentiate, but only the sums of w g of one channel: slots [P]."""
    for task in prange(num_tasks):
        for k in range(task, order.shape[0], num_tasks):
            band = order[k]
            level = band_levels[band]
            stop_row = min(band_rows[band] + BAND_ROWS, rows[level])
            for e in range(band_starts[band], band_starts[band + 1]):
                slots[pair_slots[e]] = _weigh_one(
                    gradient, offsets[level], strides[level], columns[level], band_rows[band], stop_row, splats[pair_splats[e]]
                )


@njit(cache=True)
def _weigh_one(gradient, start, stride, num_columns, first_row, stop_row, splat):
    slope = spread(np.float32(-0.5 * splat[2]))
    step = spread(np.float32(LANES))
    s0 = spread(np.float32(0))
    reach = math.sqrt(2.0 * CUT / splat[3])
    low = max(first_row, math.ceil(max(splat[1] - reach, 0.0)))
    high = min(stop_row - 1, math.floor(min(splat[1] + reach, 1e9)))
    for row in range(low, high + 1):
        first, count, centre, exponent, _ = _span(splat, row, num_columns)
        at = start + row * stride + first
        t = ramp(np.float32(first - centre))
        peak = spread(np.float32(exponent))
        for k in range(0, count, LANES):
            weight = exponential(muladd(multiply(t, t), slope, peak))
            s0 = muladd(weight, load(gradient, at + k), s0)
            t = add(t, step)
    return total(s0)


@njit(cache=True, parallel=True)
def gather(slots, slot_starts, num_chunks, sums):
    """sums [N, F] float64: each splat's slots [P, F] added up in order."""
    num = slot_starts.shape[0] - 1
    for chunk in prange(num_chunks):
        for i in range(chunk * num // num_chunks, (chunk + 1) * num // num_chunks):
            for f in range(sums.shape[1]):
                value = 0.0
                for slot in range(slot_starts[i], slot_starts[i + 1]):
                    value += slots[slot, f]
                sums[i, f] = value
