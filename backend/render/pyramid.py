"""Images of halving resolution, and up-sampling between them with a Gaussian kernel.

A smooth splat is drawn on a coarse level, narrower by what up-sampling will add, so that the sum over all levels is the
full-resolution image. Sampling a Gaussian of variance s2 and interpolating it with one of variance k2 (both in cells)
is exact but for aliasing of relative size 2 exp(-2 pi^2 s2 k2 / (s2 + k2)) per axis (Poisson summation).

Level l has cells of 2^l px; cell n is centred at (n + 1/2) 2^l px. Levels from 1 on carry MARGIN cells around the image,
and every row ROW_PADDING elements that belong to no cell. All levels of all channels lie in one flat float32 array.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from .lanes import LANES, add, flushed, load, load_stride2, muladd, spread, store, store_interleaved
from .projection import KERNEL_VARIANCE, MARGIN

ROW_PADDING = 2 * LANES
NUM_TAPS = 11
SMALLEST = np.float32(1e-25)  # smaller values are set to 0 between the passes: products of tails would be denormal


class Pyramid(NamedTuple):  # a tuple, because numba takes those
    """Where each level lies. `offsets` counts elements for one channel; with C channels a level starts at C * offset."""

    rows: np.ndarray  # [L] int64, margins included
    columns: np.ndarray  # [L] int64, margins included, padding not
    strides: np.ndarray  # [L] int64, elements per row
    offsets: np.ndarray  # [L + 1] int64


def make_pyramid(width: int, height: int, num_levels: int) -> Pyramid:
    """Levels 0 to num_levels - 1 of an image."""
    levels = range(num_levels)
    rows = np.array([math.ceil(height / 2**l) + (2 * MARGIN if l else 0) for l in levels], np.int64)
    columns = np.array([math.ceil(width / 2**l) + (2 * MARGIN if l else 0) for l in levels], np.int64)
    strides = (columns + ROW_PADDING + LANES - 1) // LANES * LANES
    offsets = np.concatenate([[0], np.cumsum(rows * strides)]).astype(np.int64)
    return Pyramid(rows=rows, columns=columns, strides=strides, offsets=offsets)


def max_levels(width: int, height: int) -> int:
    """Levels after which a whole image fits into one cell."""
    return 1 + math.ceil(math.log2(max(width, height, 1)))


def _taps() -> np.ndarray:
    """[2, NUM_TAPS]: weights of coarse cells i - 5 to i + 5 for the fine cells 2 i (at i - 1/4) and 2 i + 1 (at i + 1/4)."""
    distance = np.arange(NUM_TAPS) - NUM_TAPS // 2
    weights = np.exp(-0.5 * (distance[None] + np.array([[0.25], [-0.25]])) ** 2 / KERNEL_VARIANCE)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


TAPS = _taps()


@njit(cache=True)
def _first_tap(fine_margin):
    """Coarse cell (counted with its margin) of the first tap of fine cell 0 (counted with its margin)."""
    return MARGIN - fine_margin // 2 - NUM_TAPS // 2


@njit(cache=True, parallel=True)
def widen(coarse, start, num_lines, stride, num_pairs, fine_margin, taps, wide, wide_stride):
    """Along rows: wide [num_lines, wide_stride] gets coarse rows with fine columns."""
    first = _first_tap(fine_margin)
    for r in prange(num_lines):
        for k in range(0, num_pairs, LANES):
            even = spread(np.float32(0))
            odd = spread(np.float32(0))
            for d in range(NUM_TAPS):
                cells = load(coarse, start + r * stride + first + k + d)
                even = muladd(cells, spread(taps[0, d]), even)
                odd = muladd(cells, spread(taps[1, d]), odd)
            store_interleaved(wide, r * wide_stride + 2 * k, flushed(even, SMALLEST), flushed(odd, SMALLEST))


@njit(cache=True, parallel=True)
def heighten(wide, wide_stride, coarse_rows, num_columns, fine_margin, taps, fine, start, num_channels, num_rows, stride):
    """Along columns: adds wide [C, coarse_rows, wide_stride] to the fine level."""
    first = _first_tap(fine_margin)
    for line in prange(num_channels * num_rows):
        r = line % num_rows
        source = (line // num_rows * coarse_rows + r // 2 + first) * wide_stride
        for x in range(0, num_columns, LANES):
            cells = spread(np.float32(0))
            for d in range(NUM_TAPS):
                cells = muladd(load(wide, source + d * wide_stride + x), spread(taps[r % 2, d]), cells)
            place = start + line * stride + x
            store(fine, place, add(flushed(cells, SMALLEST), load(fine, place)))


@njit(cache=True, parallel=True)
def heighten_adjoint(
    fine, start, num_channels, num_rows, stride, num_columns, fine_margin, taps, wide, wide_stride, coarse_rows, lead
):  # fmt: skip
    """Transpose of heighten: writes wide [C, coarse_rows, wide_stride]; columns begin at `lead`, zeros around them."""
    first = _first_tap(fine_margin)
    for line in prange(num_channels * coarse_rows):
        channel, c = line // coarse_rows, line % coarse_rows
        wide[line * wide_stride : (line + 1) * wide_stride] = np.float32(0)
        low, high = max(2 * (c - first - NUM_TAPS + 1), 0), min(2 * (c - first) + 2, num_rows)
        for x in range(0, num_columns, LANES):
            cells = spread(np.float32(0))
            for r in range(low, high):
                weight = taps[r & 1, c - first - (r >> 1)]
                cells = muladd(load(fine, start + (channel * num_rows + r) * stride + x), spread(weight), cells)
            store(wide, line * wide_stride + lead + x, flushed(cells, SMALLEST))


@njit(cache=True, parallel=True)
def widen_adjoint(wide, wide_stride, lead, fine_margin, taps, coarse, start, num_lines, num_columns, stride):
    """Transpose of widen: writes the coarse level."""
    first = _first_tap(fine_margin)
    for r in prange(num_lines):
        for n in range(0, num_columns, LANES):
            cells = spread(np.float32(0))
            for d in range(NUM_TAPS):
                source = r * wide_stride + lead + 2 * (n - first - d)
                cells = muladd(load_stride2(wide, source), spread(taps[0, d]), cells)
                cells = muladd(load_stride2(wide, source + 1), spread(taps[1, d]), cells)
            store(coarse, start + r * stride + n, flushed(cells, SMALLEST))
        for n in range(num_columns, stride):
            coarse[start + r * stride + n] = np.float32(0)


def upsample(buffer: np.ndarray, pyramid: Pyramid, num_channels: int) -> None:
    """Adds every level to the next finer one, coarsest first, in place; level 0 ends as the image."""
    rows, columns, strides = pyramid.rows, pyramid.columns, pyramid.strides
    for level in range(len(rows) - 1, 0, -1):
        fine_margin = MARGIN if level > 1 else 0
        num_pairs = (columns[level - 1] + 1) // 2
        wide_stride = strides[level - 1]
        wide = np.empty(num_channels * rows[level] * wide_stride, np.float32)
        coarse, fine = num_channels * pyramid.offsets[level], num_channels * pyramid.offsets[level - 1]
        widen(buffer, coarse, num_channels * rows[level], strides[level], num_pairs, fine_margin, TAPS, wide, wide_stride)
        heighten(
            wide, wide_stride, rows[level], columns[level - 1], fine_margin, TAPS, buffer, fine, num_channels, rows[level - 1],
            strides[level - 1],
        )  # fmt: skip


def upsample_adjoint(buffer: np.ndarray, pyramid: Pyramid, num_channels: int) -> None:
    """Transpose of upsample: from the gradient on level 0 (its padding zero) those on all the others, in place."""
    rows, columns, strides = pyramid.rows, pyramid.columns, pyramid.strides
    lead = 4 * LANES  # the reach of the taps before the first fine column
    for level in range(1, len(rows)):
        fine_margin = MARGIN if level > 1 else 0
        wide_stride = strides[level - 1] + 2 * lead + 4 * LANES
        wide = np.empty(num_channels * rows[level] * wide_stride, np.float32)
        coarse, fine = num_channels * pyramid.offsets[level], num_channels * pyramid.offsets[level - 1]
        heighten_adjoint(
            buffer, fine, num_channels, rows[level - 1], strides[level - 1], columns[level - 1], fine_margin, TAPS, wide,
            wide_stride, rows[level], lead,
        )  # fmt: skip
        widen_adjoint(
            wide, wide_stride, lead, fine_margin, TAPS, buffer, coarse, num_channels * rows[level], columns[level], strides[level]
        )
