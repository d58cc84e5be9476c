"""Which particles are near which: a grid of cells that wraps around, and lists without a limit on their length.

Cells are as wide as the search radius, so a point's neighbours lie in the 3 x 3 x 3 cells about its own. The grid has
about as many cells as there are particles, whatever their extent: cell coordinates wrap around, so that far cells may
share a place. That only adds candidates which the distance test drops; nothing is ever found twice, because a grid is
at least three cells wide. Particles are binned in chunks whose order is fixed, and every list is written by one
thread, so that the result is the same for any number of threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

_CHUNK = 2048  # particles binned by one thread at a time
_MAX_CHUNKS = 16
_SLACK = 1e-6  # share by which a cell is wider than the radius, so that rounding cannot skip a cell


@dataclass(frozen=True, slots=True, kw_only=True)
class CellGrid:
    """Particles sorted by cell. Cell (i, j, k) is number (i * shape[1] + j) * shape[2] + k."""

    cell_size: float  # m
    shape: tuple[int, int, int]  # cells along x, y, z before it wraps, at least 3 each
    starts: np.ndarray  # [C + 1] int64 into order
    order: np.ndarray  # [N] int64, particles by cell, ascending within one
    coordinates: np.ndarray  # [3, N] m, positions in that order


@dataclass(frozen=True, slots=True, kw_only=True)
class Neighbours:
    """Neighbour lists in compressed rows: those of particle i are indices[starts[i] : starts[i + 1]], without i itself."""

    starts: np.ndarray  # [N + 1] int64
    indices: np.ndarray  # [P] int32


@njit(cache=True, inline="always")
def _wrapped(value, cell_size, count):
    """Cell coordinate of a coordinate, wrapped into 0 .. count - 1."""
    cell = math.floor(value / cell_size)
    return min(max(int(cell - math.floor(cell / count) * count), 0), count - 1)


@njit(cache=True, parallel=True, error_model="numpy")
def _bin(positions, cell_size, shape, num_chunks, cells, counts):
    """cells [N]: number of each particle's cell; counts [chunks, C]: particles of each chunk in each cell."""
    num = positions.shape[0]
    for chunk in prange(num_chunks):
        for i in range(chunk * num // num_chunks, (chunk + 1) * num // num_chunks):
            x = _wrapped(positions[i, 0], cell_size, shape[0])
            y = _wrapped(positions[i, 1], cell_size, shape[1])
            z = _wrapped(positions[i, 2], cell_size, shape[2])
            cells[i] = (x * shape[1] + y) * shape[2] + z
            counts[chunk, cells[i]] += 1


@njit(cache=True, parallel=True)
def _sort(positions, cells, num_chunks, cursors, order, coordinates):
    """Fills order and coordinates. cursors [chunks, C]: where each chunk begins in each cell."""
    num = positions.shape[0]
    for chunk in prange(num_chunks):
        for i in range(chunk * num // num_chunks, (chunk + 1) * num // num_chunks):
            at = cursors[chunk, cells[i]]
            cursors[chunk, cells[i]] = at + 1
            order[at] = i
            for axis in range(3):
                coordinates[axis, at] = positions[i, axis]


def build_grid(
    positions: np.ndarray,  # [N, 3] m
    radius: float,  # m
    *,
    reach: float = 0.0,  # m, largest |coordinate| that will be asked about, if larger than the particles'
) -> CellGrid:
    """Sorts particles into cells at least `radius` wide."""
    largest = max(reach, float(np.abs(positions).max(initial=0.0)))
    # A cell must also be wider than the rounding of its own number.
    cell_size = max(radius * (1.0 + _SLACK), 8.0 * np.finfo(np.float64).eps * largest)
    shape = _grid_shape(positions, cell_size)
    num_chunks = max(1, min(_MAX_CHUNKS, len(positions) // _CHUNK))
    cells = np.empty(len(positions), np.int64)
    counts = np.zeros((num_chunks, math.prod(shape)), np.int64)
    _bin(positions, cell_size, shape, num_chunks, cells, counts)
    starts = np.zeros(counts.shape[1] + 1, np.int64)
    np.cumsum(counts.sum(axis=0), out=starts[1:])
    cursors = starts[:-1] + np.cumsum(counts, axis=0) - counts
    order = np.empty(len(positions), np.int64)
    coordinates = np.empty((3, len(positions)))
    _sort(positions, cells, num_chunks, cursors, order, coordinates)
    return CellGrid(cell_size=cell_size, shape=shape, starts=starts, order=order, coordinates=coordinates)


def _grid_shape(positions: np.ndarray, cell_size: float) -> tuple[int, int, int]:
    """As many cells as the particles span, but not many more than there are particles, and at least 3 along each axis."""
    if len(positions) == 0:
        return (3, 3, 3)
    spans = np.floor(positions.max(axis=0) / cell_size) - np.floor(positions.min(axis=0) / cell_size) + 1.0
    budget = max(len(positions), 64)
    spans = np.clip(spans, 3.0, float(budget))
    while spans.prod() > budget and spans.max() > 3.0:
        axis = int(np.argmax(spans))
        spans[axis] = max(3.0, math.floor(spans[axis] / 2.0))
    return (int(spans[0]), int(spans[1]), int(spans[2]))


@njit(cache=True, inline="always")
def cell_rows(x, y, z, cell_size, shape, starts, ranges):
    """The candidates about a point, as ranges of the sorted particles: fills ranges [27, 2], returns how many.

    Cells along z are adjacent in memory, so that away from the seam three cells are one range.
    """
    count = 0
    cx, cy, cz = _wrapped(x, cell_size, shape[0]), _wrapped(y, cell_size, shape[1]), _wrapped(z, cell_size, shape[2])
    is_whole = 0 < cz < shape[2] - 1
    for i in range(-1, 2):
        for j in range(-1, 2):
            row = ((cx + i + shape[0]) % shape[0] * shape[1] + (cy + j + shape[1]) % shape[1]) * shape[2]
            if is_whole:
                ranges[count, 0], ranges[count, 1] = starts[row + cz - 1], starts[row + cz + 2]
                count += 1
            else:
                for k in range(-1, 2):
                    cell = row + (cz + k + shape[2]) % shape[2]
                    ranges[count, 0], ranges[count, 1] = starts[cell], starts[cell + 1]
                    count += 1
    return count


@njit(cache=True, parallel=True, error_model="numpy")
def _count_neighbours(cell_size, shape, starts, order, coordinates, radius_squared, num_tasks, counts):
    """counts [N]: particles within the radius of each, without itself."""
    num = order.shape[0]
    xs, ys, zs = coordinates[0], coordinates[1], coordinates[2]
    for task in prange(num_tasks):
        ranges = np.empty((27, 2), np.int64)
        for at in range(task * num // num_tasks, (task + 1) * num // num_tasks):
            x, y, z = xs[at], ys[at], zs[at]
            found = 0
            for row in range(cell_rows(x, y, z, cell_size, shape, starts, ranges)):
                for k in range(ranges[row, 0], ranges[row, 1]):
                    dx, dy, dz = xs[k] - x, ys[k] - y, zs[k] - z
                    found += dx * dx + dy * dy + dz * dz < radius_squared
            counts[order[at]] = found - 1


@njit(cache=True, parallel=True, error_model="numpy")
def _fill_neighbours(cell_size, shape, starts, order, coordinates, radius_squared, num_tasks, row_starts, indices):
    """Writes the lists that `_count_neighbours` has measured."""
    num = order.shape[0]
    xs, ys, zs = coordinates[0], coordinates[1], coordinates[2]
    for task in prange(num_tasks):
        ranges = np.empty((27, 2), np.int64)
        for at in range(task * num // num_tasks, (task + 1) * num // num_tasks):
            x, y, z = xs[at], ys[at], zs[at]
            write = row_starts[order[at]]
            for row in range(cell_rows(x, y, z, cell_size, shape, starts, ranges)):
                for k in range(ranges[row, 0], ranges[row, 1]):
                    dx, dy, dz = xs[k] - x, ys[k] - y, zs[k] - z
                    if dx * dx + dy * dy + dz * dz < radius_squared and k != at:
                        indices[write] = order[k]
                        write += 1


def find_neighbours(
    positions: np.ndarray,  # [N, 3] m, finite
    radius: float,  # m
) -> Neighbours:
    """All pairs closer than `radius`; a pair is in both lists. The order within a list is fixed by the positions."""
    grid = build_grid(positions, radius)
    num_tasks = max(1, min(256, len(positions) // 64))
    row_starts = np.zeros(len(positions) + 1, np.int64)
    shared = (grid.cell_size, grid.shape, grid.starts, grid.order, grid.coordinates, radius * radius, num_tasks)
    _count_neighbours(*shared, row_starts[1:])
    np.cumsum(row_starts, out=row_starts)
    indices = np.empty(row_starts[-1], np.int32)
    _fill_neighbours(*shared, row_starts, indices)
    return Neighbours(starts=row_starts, indices=indices)
