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
def widen(coarse, start, num_lines, stride, num_pairs, fine_margin, taps, out, out_stride):
    """Along rows: out [num_lines, 2, out_stride] gets the even and the odd fine columns, num_pairs of each."""
    first = _first_tap(fine_margin)
    for r in prange(num_lines):
        source = start + r * stride + first
        for k in range(0, num_pairs, LANES):
            even = spread(np.float32(0))
            odd = spread(np.float32(0))
            for d in range(NUM_TAPS):
                cells = load(coarse, source + k + d)
                even = muladd(cells, spread(taps[0, d]), even)
                odd = muladd(cells, spread(taps[1, d]), odd)
            store(out, (2 * r) * out_stride + k, flushed(even, SMALLEST))
            store(out, (2 * r + 1) * out_stride + k, flushed(odd, SMALLEST))


@njit(cache=True, parallel=True)
def heighten(wide, wide_stride, coarse_rows, num_pairs, fine_margin, taps, fine, start, num_channels, num_rows, stride):
    """Along columns: adds the up-sampled coarse level, wide [C, coarse_rows, 2, wide_stride], to the fine one."""
    first = _first_tap(fine_margin)
    for line in prange(num_channels * num_rows):
        r = line % num_rows
        source = (line // num_rows * coarse_rows + r // 2 + first) * 2 * wide_stride
        for k in range(0, num_pairs, LANES):
            even = spread(np.float32(0))
            odd = spread(np.float32(0))
            for d in range(NUM_TAPS):
                weight = spread(taps[r % 2, d])
                even = muladd(load(wide, source + 2 * d * wide_stride + k), weight, even)
                odd = muladd(load(wide, source + (2 * d + 1) * wide_stride + k), weight, odd)
            target = start + line * stride + 2 * k
            even = add(flushed(even, SMALLEST), load_stride2(fine, target))
            odd = add(flushed(odd, SMALLEST), load_stride2(fine, target + 1))
            store_interleaved(fine, target, even, odd)


@njit(cache=True, parallel=True)
def heighten_adjoint(
    fine, start, num_channels, num_rows, stride, num_pairs, fine_margin, taps, wide, wide_stride, coarse_rows, lead
):  # fmt: skip
    """Transpose of heighten: writes wide [C, coarse_rows, 2, wide_stride]; columns begin at `lead`, zeros around them."""
    first = _first_tap(fine_margin)
    for line in prange(num_channels * coarse_rows):
        channel, c = line // coarse_rows, line % coarse_rows
        wide[2 * line * wide_stride : 2 * (line + 1) * wide_stride] = np.float32(0)
        for k in range(0, num_pairs, LANES):
            even = spread(np.float32(0))
            odd = spread(np.float32(0))
            for d in range(NUM_TAPS):
                for parity in range(2):
                    r = 2 * (c - first - d) + parity
                    if 0 <= r < num_rows:
                        source = start + (channel * num_rows + r) * stride + 2 * k
                        weight = spread(taps[parity, d])
                        even = muladd(load_stride2(fine, source), weight, even)
                        odd = muladd(load_stride2(fine, source + 1), weight, odd)
            store(wide, 2 * line * wide_stride + lead + k, flushed(even, SMALLEST))
            store(wide, (2 * line + 1) * wide_stride + lead + k, flushed(odd, SMALLEST))


@njit(cache=True, parallel=True)
def widen_adjoint(wide, wide_stride, lead, fine_margin, taps, coarse, start, num_lines, num_columns, stride):
    """Transpose of widen: writes the coarse level."""
    first = _first_tap(fine_margin)
    for r in prange(num_lines):
        for n in range(0, num_columns, LANES):
            cells = spread(np.float32(0))
            for d in range(NUM_TAPS):
                source = 2 * r * wide_stride + lead + n - first - d
                cells = muladd(load(wide, source), spread(taps[0, d]), cells)
                cells = muladd(load(wide, source + wide_stride), spread(taps[1, d]), cells)
            store(coarse, start + r * stride + n, flushed(cells, SMALLEST))
        for n in range(num_columns, stride):
            coarse[start + r * stride + n] = np.float32(0)


def upsample(buffer: np.ndarray, pyramid: Pyramid, num_channels: int) -> None:
    """Adds every level to the next finer one, coarsest first, in place; level 0 ends as the image."""
    rows, strides = pyramid.rows, pyramid.strides
    for level in range(len(rows) - 1, 0, -1):
        fine_margin, num_pairs, wide_stride = _columns(pyramid, level)
        wide = np.empty(num_channels * 2 * rows[level] * wide_stride + ROW_PADDING, np.float32)
        coarse, fine = num_channels * pyramid.offsets[level], num_channels * pyramid.offsets[level - 1]
        widen(buffer, coarse, num_channels * rows[level], strides[level], num_pairs, fine_margin, TAPS, wide, wide_stride)
        heighten(
            wide, wide_stride, rows[level], num_pairs, fine_margin, TAPS, buffer, fine, num_channels, rows[level - 1],
            strides[level - 1],
        )  # fmt: skip


def upsample_adjoint(buffer: np.ndarray, pyramid: Pyramid, num_channels: int) -> None:
    """Transpose of upsample: from the gradient on level 0 (its padding zero) those on all the others, in place."""
    rows, strides = pyramid.rows, pyramid.strides
    lead = 2 * LANES
    for level in range(1, len(rows)):
        fine_margin, num_pairs, wide_stride = _columns(pyramid, level)
        wide_stride += 2 * lead
        wide = np.empty(num_channels * 2 * rows[level] * wide_stride + ROW_PADDING, np.float32)
        coarse, fine = num_channels * pyramid.offsets[level], num_channels * pyramid.offsets[level - 1]
        heighten_adjoint(
            buffer, fine, num_channels, rows[level - 1], strides[level - 1], num_pairs, fine_margin, TAPS, wide, wide_stride,
            rows[level], lead,
        )  # fmt: skip
        widen_adjoint(
            wide, wide_stride, lead, fine_margin, TAPS, buffer, coarse, num_channels * rows[level], pyramid.columns[level],
            strides[level],
        )  # fmt: skip


def _columns(pyramid: Pyramid, level: int) -> tuple[int, int, int]:
    """For up-sampling from `level`: margin of the finer level, its pairs of columns, elements for a padded row of them."""
    num_pairs = (int(pyramid.columns[level - 1]) + 1) // 2
    return (MARGIN if level > 1 else 0), num_pairs, (num_pairs + 2 * LANES - 1) // LANES * LANES
