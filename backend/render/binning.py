"""Which splats touch which band of rows: counted and filled in parallel, in the same order for any number of threads.

A band is BAND_ROWS rows of one level over its full width; bands are numbered through all levels. One pair is one splat
on one band. Bands list their splats in order of index; slots number the pairs by splat, so that a splat's are adjacent.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from .pyramid import Pyramid

BAND_ROWS = 16


class Bins(NamedTuple):  # a tuple, because numba takes those
    """Splats by band, P pairs in all."""

    band_levels: np.ndarray  # [B] int64
    band_rows: np.ndarray  # [B] int64, first row
    band_starts: np.ndarray  # [B + 1] int64 into pair_splats and pair_slots
    pair_splats: np.ndarray  # [P] int64
    pair_slots: np.ndarray  # [P] int64
    slot_starts: np.ndarray  # [N + 1] int64
    order: np.ndarray  # [B] int64, bands with most pairs first: dealt in turn, they load the threads evenly


@njit(cache=True, parallel=True)
def _count(levels, boxes, first_bands, num_chunks, counts, num_slots):
    """counts [chunks, B]: pairs of each band in each chunk of splats; num_slots [N]: bands of each splat."""
    num = levels.shape[0]
    for chunk in prange(num_chunks):
        for i in range(chunk * num // num_chunks, (chunk + 1) * num // num_chunks):
            num_slots[i] = 0
            if levels[i] >= 0:
                base = first_bands[levels[i]]
                low, high = boxes[i, 0] // BAND_ROWS, boxes[i, 1] // BAND_ROWS
                num_slots[i] = high - low + 1
                for band in range(low, high + 1):
                    counts[chunk, base + band] += 1


@njit(cache=True, parallel=True)
def _fill(levels, boxes, first_bands, num_chunks, cursors, slot_starts, pair_splats, pair_slots):
    """cursors [chunks, B]: where each chunk begins in each band."""
    num = levels.shape[0]
    for chunk in prange(num_chunks):
        for i in range(chunk * num // num_chunks, (chunk + 1) * num // num_chunks):
            if levels[i] >= 0:
                base = first_bands[levels[i]]
                low = boxes[i, 0] // BAND_ROWS
                for band in range(low, boxes[i, 1] // BAND_ROWS + 1):
                    at = cursors[chunk, base + band]
                    pair_splats[at] = i
                    pair_slots[at] = slot_starts[i] + band - low
                    cursors[chunk, base + band] = at + 1


def bin_splats(pyramid: Pyramid, levels: np.ndarray, boxes: np.ndarray) -> Bins:
    """levels [N] int64 (-1: none), boxes [N, 4] int64: first and last row, first and last column on the level."""
    bands_of_level = -(-pyramid.rows // BAND_ROWS)
    first_bands = np.concatenate([[0], np.cumsum(bands_of_level)]).astype(np.int64)
    num_bands = int(first_bands[-1])
    num_chunks = max(1, min(64, len(levels) // 256))
    counts = np.zeros((num_chunks, num_bands), np.int64)
    num_slots = np.empty(len(levels), np.int64)
    _count(levels, boxes, first_bands, num_chunks, counts, num_slots)
    slot_starts = np.concatenate([[0], np.cumsum(num_slots)]).astype(np.int64)
    band_starts = np.concatenate([[0], np.cumsum(counts.sum(axis=0))]).astype(np.int64)
    cursors = band_starts[:-1] + np.cumsum(counts, axis=0) - counts
    pair_splats = np.empty(band_starts[-1], np.int64)
    pair_slots = np.empty(band_starts[-1], np.int64)
    _fill(levels, boxes, first_bands, num_chunks, cursors, slot_starts, pair_splats, pair_slots)
    return Bins(
        band_levels=np.repeat(np.arange(len(bands_of_level)), bands_of_level),
        band_rows=np.concatenate([np.arange(n) * BAND_ROWS for n in bands_of_level]).astype(np.int64),
        band_starts=band_starts,
        pair_splats=pair_splats,
        pair_slots=pair_slots,
        slot_starts=slot_starts,
        order=np.argsort(-np.diff(band_starts), kind="stable"),
    )
