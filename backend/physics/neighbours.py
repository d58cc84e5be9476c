"""Which particles are near which: a grid of cells that wraps around, and lists without a limit on their length.

Cells are as wide as the search radius and a quarter of it high, so a point's neighbours lie in 3 x 3 columns of cells,
each cut to the height that the search ball has there. The grid has about as many cells as there are particles,
whatever their extent: cell coordinates wrap around, so that far cells may share a place. That only adds candidates
which the distance test drops; nothing is found twice, because no column is searched twice and none longer than it is.
Particles are binned in chunks whose order is fixed, and every list is written by one thread, so that the result is
the same for any number of threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from backend.contract.errors import BackendError

_CHUNK = 2048  # particles binned by one thread at a time
_MAX_CHUNKS = 16
_FINE = 4  # cells along z in the width of one
_SLACK = 1e-6  # share by which a cell is wider than the radius, so that rounding cannot skip a cell
_MOST_PAIRS = 4e9  # within single cells; the lists would take some 10 GB
MAX_RANGES = 18  # of candidates about a point: nine columns, each cut at most once by the seam


@dataclass(frozen=True, slots=True, kw_only=True)
class CellGrid:
    """Particles sorted by cell. Cell (i, j, k) is number (i * shape[1] + j) * shape[2] + k."""

    cell_size: float  # m, along x and y; a quarter of it along z
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
            z = _wrapped(positions[i, 2], cell_size / _FINE, shape[2])
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
    cell_size = max(radius * (1.0 + _SLACK), 32.0 * np.finfo(np.float64).eps * largest)
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
    sizes = np.array([cell_size, cell_size, cell_size / _FINE])
    spans = np.floor(positions.max(axis=0) / sizes) - np.floor(positions.min(axis=0) / sizes) + 1.0
    budget = max(2 * len(positions), 64)
    spans = np.clip(spans, 3.0, float(budget))
    while spans.prod() > budget and spans.max() > 3.0:
        axis = int(np.argmax(spans))
        spans[axis] = max(3.0, math.floor(spans[axis] / 2.0))
    return (int(spans[0]), int(spans[1]), int(spans[2]))


@njit(cache=True, inline="always")
def _gap(value, cell, cell_size, side):
    """Distance along one axis from a coordinate in its cell to the cell before (side -1) or after (1), less the slack."""
    if side == 0:
        return 0.0
    face = (cell + 1.0) * cell_size - value if side > 0 else value - cell * cell_size
    return max(face - _SLACK * cell_size, 0.0)


@njit(cache=True)
def candidate_ranges(x, y, z, radius, cell_size, shape, starts, ranges):
    """Where the sorted particles within the radius of a point may be: fills ranges [MAX_RANGES, 2], returns how many."""
    count = 0
    fine = cell_size / _FINE
    cell_x, cell_y = math.floor(x / cell_size), math.floor(y / cell_size)
    wrapped_x, wrapped_y = _wrapped(x, cell_size, shape[0]), _wrapped(y, cell_size, shape[1])
    for i in range(-1, 2):
        gap_x = _gap(x, cell_x, cell_size, i)
        for j in range(-1, 2):
            gap_y = _gap(y, cell_y, cell_size, j)
            squared = radius * radius - gap_x * gap_x - gap_y * gap_y
            if squared >= 0.0:
                half = math.sqrt(squared) + _SLACK * cell_size
                num_cells = int(math.floor((z + half) / fine) - math.floor((z - half) / fine)) + 1
                first = _wrapped(z - half, fine, shape[2])
                stop = first + min(num_cells, shape[2])
                column = ((wrapped_x + i + shape[0]) % shape[0] * shape[1] + (wrapped_y + j + shape[1]) % shape[1]) * shape[2]
                ranges[count, 0], ranges[count, 1] = starts[column + first], starts[column + min(stop, shape[2])]
                count += 1
                if stop > shape[2]:
                    ranges[count, 0], ranges[count, 1] = starts[column], starts[column + stop - shape[2]]
                    count += 1
    return count


@njit(cache=True, parallel=True, error_model="numpy")
def _count_neighbours(radius, cell_size, shape, starts, order, coordinates, num_tasks, counts):
    """counts [N]: particles within the radius of each, without itself."""
    num = order.shape[0]
    for task in prange(num_tasks):
        ranges = np.empty((MAX_RANGES, 2), np.int64)
        for at in range(task * num // num_tasks, (task + 1) * num // num_tasks):
            x, y, z = coordinates[0, at], coordinates[1, at], coordinates[2, at]
            found = 0
            for row in range(candidate_ranges(x, y, z, radius, cell_size, shape, starts, ranges)):
                first, stop = ranges[row, 0], ranges[row, 1]
                xs, ys, zs = coordinates[0, first:stop], coordinates[1, first:stop], coordinates[2, first:stop]
                for k in range(stop - first):
                    dx, dy, dz = xs[k] - x, ys[k] - y, zs[k] - z
                    found += 1 if dx * dx + dy * dy + dz * dz < radius * radius else 0
            counts[order[at]] = found - 1


@njit(cache=True, parallel=True, error_model="numpy")
def _fill_neighbours(radius, cell_size, shape, starts, order, coordinates, num_tasks, longest, row_starts, indices):
    """Writes the lists that `_count_neighbours` has measured. longest: of the lists.

    A candidate is written before it is known to be one and overwritten if it is not: no branch to mispredict.
    """
    num = order.shape[0]
    for task in prange(num_tasks):
        ranges = np.empty((MAX_RANGES, 2), np.int64)
        found = np.empty(longest + 2, np.int32)
        for at in range(task * num // num_tasks, (task + 1) * num // num_tasks):
            x, y, z = coordinates[0, at], coordinates[1, at], coordinates[2, at]
            write = np.uint64(0)
            for row in range(candidate_ranges(x, y, z, radius, cell_size, shape, starts, ranges)):
                for k in range(ranges[row, 0], ranges[row, 1]):
                    dx, dy, dz = coordinates[0, k] - x, coordinates[1, k] - y, coordinates[2, k] - z
                    found[write] = k
                    write += np.uint64((dx * dx + dy * dy + dz * dz < radius * radius) & (k != at))
            first = row_starts[order[at]]
            for k in range(np.int64(write)):
                indices[first + k] = order[found[k]]


def find_neighbours(
    positions: np.ndarray,  # [N, 3] m, finite
    radius: float,  # m
) -> Neighbours:
    """All pairs closer than `radius`; a pair is in both lists. The order within a list is fixed by the positions.

    Raises BackendError where so many particles crowd that their pairs fit into no memory.
    """
    grid = build_grid(positions, radius)
    in_cell = np.diff(grid.starts).astype(np.float64)
    if float(in_cell @ in_cell) > _MOST_PAIRS:
        raise BackendError(
            "particles_too_crowded",
            f"{int(in_cell.max())} of {len(positions)} particles crowd into one smoothing length.",
            hint="Ask for fewer particles, or for frames that show more smoke.",
        )
    num_tasks = max(1, min(256, len(positions) // 64))
    row_starts = np.zeros(len(positions) + 1, np.int64)
    shared = (radius, grid.cell_size, grid.shape, grid.starts, grid.order, grid.coordinates, num_tasks)
    _count_neighbours(*shared, row_starts[1:])
    longest = int(row_starts.max())
    np.cumsum(row_starts, out=row_starts)
    indices = np.empty(row_starts[-1], np.int32)
    _fill_neighbours(*shared, longest, row_starts, indices)
    return Neighbours(starts=row_starts, indices=indices)
