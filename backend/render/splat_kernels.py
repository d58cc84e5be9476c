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
from .lanes import LANES, add, exponential, larger_magnitude, load, muladd, multiply, ramp, spread, store, total
from .projection import CUT

NARROW = 4 * LANES  # columns
NUM_SUMS = 6  # of w g (S0), w g t (S1), w g t^2 (S2), w g dy (Y1), w g dy^2 (Y2), w g t dy (X)


@njit(cache=True, forceinline=True)
def row_of(u, v, a, b, s, left, right, row, num_columns):
    """One row of a splat: first cell, number of cells rounded up to LANES (0: none), t there, exponent at t = 0, dy.

    A narrow splat takes its whole box in every row: finding each row's own span would cost more than it saves.
    """
    dy = row - v
    exponent = -0.5 * b * dy * dy
    centre = u + s * dy
    if right - left >= NARROW:
        half = math.sqrt(max(2.0 * (CUT + exponent), 0.0) / a)
        left = math.ceil(min(max(centre - half, 0.0), float(num_columns)))
        right = math.floor(max(min(centre + half, num_columns - 1.0), -1.0))
    count = max(right - left + LANES, 0) & -LANES
    return left, count, np.float32(left - centre), np.float32(exponent), np.float32(dy)


@njit(cache=True, forceinline=True)
def place_of(pyramid, bins, band, num_channels):
    """Of a band: element where its level starts, elements per channel and per row, columns, first row, row after the last."""
    level = bins.band_levels[band]
    rows, stride = pyramid.rows[level], pyramid.strides[level]
    first = bins.band_rows[band]
    return (
        num_channels * pyramid.offsets[level],
        rows * stride,
        stride,
        pyramid.columns[level],
        first,
        min(first + BAND_ROWS, rows),
    )


@njit(cache=True, parallel=True)
def draw(buffer, pyramid, bins, splats, boxes, amplitudes, features, num_tasks):
    """Writes all bands of buffer (flat, see pyramid.py): channel 0 sum of A w, channel 1 + k sum of A w c_k.

    amplitudes [N] float32, features [N, K] float32. The bands are dealt to num_tasks tasks.
    """
    num_features = features.shape[1]
    for task in prange(num_tasks):
        tints = np.empty(num_features, np.float32)
        for k in range(task, bins.order.shape[0], num_tasks):
            band = bins.order[k]
            start, plane, stride, num_columns, first_row, stop_row = place_of(pyramid, bins, band, 1 + num_features)
            for c in range(1 + num_features):
                buffer[start + c * plane + first_row * stride : start + c * plane + stop_row * stride] = np.float32(0)
            for e in range(bins.band_starts[band], bins.band_starts[band + 1]):
                i = bins.pair_splats[e]
                if amplitudes[i] != np.float32(0):
                    for c in range(num_features):
                        tints[c] = amplitudes[i] * features[i, c]
                    low, high = max(first_row, boxes[i, 0]), min(stop_row, boxes[i, 1] + 1)
                    _draw_one(buffer, start, plane, stride, num_columns, low, high, splats, boxes, i, amplitudes[i], tints)


@njit(cache=True, forceinline=True)
def _draw_one(buffer, start, plane, stride, num_columns, first_row, stop_row, splats, boxes, i, amplitude, tints):
    u, v, a, b, s = splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 3], splats[i, 4]
    left, right = boxes[i, 2], boxes[i, 3]
    slope = spread(np.float32(-0.5 * a))
    step = spread(np.float32(LANES))
    strength = spread(amplitude)
    for row in range(first_row, stop_row):
        first, count, t0, exponent, _ = row_of(u, v, a, b, s, left, right, row, num_columns)
        t = ramp(t0)
        peak = spread(exponent)
        at = start + row * stride + first
        for place in range(at, at + count, LANES):
            weight = exponential(muladd(multiply(t, t), slope, peak))
            store(buffer, place, muladd(weight, strength, load(buffer, place)))
            for c in range(tints.shape[0]):
                tinted = place + (c + 1) * plane
                store(buffer, tinted, muladd(weight, spread(tints[c]), load(buffer, tinted)))
            t = add(t, step)


@njit(cache=True, parallel=True)
def differentiate(gradient, pyramid, bins, splats, boxes, features, num_tasks, slots):
    """Adjoint of draw: slots [P, NUM_SUMS + K] float32, sums over the pair's cells of unit-amplitude terms.

    With g = gradient of channel 0 plus sum of c_k times that of channel 1 + k: the six sums, then sum of w g_k for each k.
    """
    num_features = features.shape[1]
    for task in prange(num_tasks):
        scratch = np.empty(LANES * num_features, np.float32)
        for k in range(task, bins.order.shape[0], num_tasks):
            band = bins.order[k]
            start, plane, stride, num_columns, first_row, stop_row = place_of(pyramid, bins, band, 1 + num_features)
            for e in range(bins.band_starts[band], bins.band_starts[band + 1]):
                i, slot = bins.pair_splats[e], bins.pair_slots[e]
                low, high = max(first_row, boxes[i, 0]), min(stop_row, boxes[i, 1] + 1)
                _differentiate_one(
                    gradient, start, plane, stride, num_columns, low, high, splats, boxes, i, features, scratch, slots, slot
                )  # fmt: skip


@njit(cache=True, forceinline=True)
def _differentiate_one(
    gradient, start, plane, stride, num_columns, first_row, stop_row, splats, boxes, i, features, scratch, slots, slot
):
    u, v, a, b, s = splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 3], splats[i, 4]
    left, right = boxes[i, 2], boxes[i, 3]
    num_features = features.shape[1]
    zero = spread(np.float32(0))
    slope = spread(np.float32(-0.5 * a))
    step = spread(np.float32(LANES))
    s0, s1, s2, y1, y2, x1 = zero, zero, zero, zero, zero, zero
    for c in range(num_features):
        store(scratch, c * LANES, zero)
    for row in range(first_row, stop_row):
        first, count, t0, exponent, dy = row_of(u, v, a, b, s, left, right, row, num_columns)
        t = ramp(t0)
        peak = spread(exponent)
        r0, r1, r2 = zero, zero, zero
        at = start + row * stride + first
        for place in range(at, at + count, LANES):
            square = multiply(t, t)
            weight = exponential(muladd(square, slope, peak))
            g = load(gradient, place)
            for c in range(num_features):
                g_c = load(gradient, place + (c + 1) * plane)
                g = muladd(spread(features[i, c]), g_c, g)
                store(scratch, c * LANES, muladd(weight, g_c, load(scratch, c * LANES)))
            weighted = multiply(weight, g)
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


@njit(cache=True, parallel=True)
def weigh(gradient, pyramid, bins, splats, boxes, num_tasks, slots):
    """As differentiate, but only the sums of w g of one channel: slots [P]."""
    for task in prange(num_tasks):
        for k in range(task, bins.order.shape[0], num_tasks):
            band = bins.order[k]
            start, _, stride, num_columns, first_row, stop_row = place_of(pyramid, bins, band, 1)
            for e in range(bins.band_starts[band], bins.band_starts[band + 1]):
                i = bins.pair_splats[e]
                low, high = max(first_row, boxes[i, 0]), min(stop_row, boxes[i, 1] + 1)
                slots[bins.pair_slots[e]] = _weigh_one(gradient, start, stride, num_columns, low, high, splats, boxes, i)


@njit(cache=True, forceinline=True)
def _weigh_one(gradient, start, stride, num_columns, first_row, stop_row, splats, boxes, i):
    u, v, a, b, s = splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 3], splats[i, 4]
    left, right = boxes[i, 2], boxes[i, 3]
    slope = spread(np.float32(-0.5 * a))
    step = spread(np.float32(LANES))
    s0 = spread(np.float32(0))
    for row in range(first_row, stop_row):
        first, count, t0, exponent, _ = row_of(u, v, a, b, s, left, right, row, num_columns)
        t = ramp(t0)
        peak = spread(exponent)
        at = start + row * stride + first
        for place in range(at, at + count, LANES):
            s0 = muladd(exponential(muladd(multiply(t, t), slope, peak)), load(gradient, place), s0)
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


@njit(cache=True, parallel=True)
def largest_magnitude(values, per_chunk):
    """per_chunk [C]: largest |value| in each of C equal parts of values (flat float32); NaN if one is not finite."""
    num, num_chunks = values.shape[0], per_chunk.shape[0]
    zero = np.float32(0)
    for chunk in prange(num_chunks):
        start, stop = chunk * num // num_chunks, (chunk + 1) * num // num_chunks
        whole = start + ((stop - start) & -LANES)
        found = np.zeros(LANES, np.float32)
        magnitudes, nothing = spread(zero), spread(zero)
        for k in range(start, whole, LANES):
            cells = load(values, k)
            magnitudes = larger_magnitude(magnitudes, cells)
            nothing = muladd(cells, spread(zero), nothing)  # 0, or NaN
        store(found, 0, add(magnitudes, nothing))
        largest, missing = zero, zero
        for x in found:
            largest, missing = max(largest, x), missing + x * zero
        for k in range(whole, stop):
            largest, missing = max(largest, abs(values[k])), missing + values[k] * zero
        per_chunk[chunk] = largest + missing


@njit(cache=True, parallel=True)
def scaled_into(values, width, factor, smallest, out, stride):
    """out (rows of `stride` elements) gets the rows of `width` of values, times factor, 0 below smallest; then zeros."""
    for r in prange(values.shape[0] // width):
        for x in range(width):
            value = values[r * width + x] * factor
            out[r * stride + x] = value if abs(value) > smallest else np.float32(0)
        for x in range(width, stride):
            out[r * stride + x] = np.float32(0)


@njit(cache=True, parallel=True)
def copy_rows(source, stride, image):
    """image [C, H, W] from the flat `source` with rows of `stride` elements."""
    num_channels, num_rows, width = image.shape
    for r in prange(num_channels * num_rows):
        image[r // num_rows, r % num_rows] = source[r * stride : r * stride + width]
