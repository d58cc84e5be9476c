"""How much work the backend does, counted instead of timed: the same on every machine and however busy it is.

Nothing of this is in the backend: while `counted` holds, its functions are wrapped from outside, wherever they were imported to;
afterwards they are what they were. Counted are

    kernel_elements     elements of all arrays handed to compiled kernels, whichever they are
    splat_cells         cells that splats are drawn to or differentiated on, times channels
    neighbour_visits    pairs of particles that the fluid goes through, and those found for it
    prior_operations    floating-point operations of the network, as torch counts them
    voxels_filled       voxels that Gaussians are summed into
    voxels_written      values of VDB grids

but for what the machine is timed with before an estimate: that is no part of a job, and done once on a machine.
Instructions would say more, but processors count them only where the system lets one ask: not in most containers and virtual
machines that tests run in; and to simulate them costs fifty times the time and knows no new vector instructions.
"""

from __future__ import annotations

import functools
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import numpy as np
import torch
from numba.core.registry import CPUDispatcher
from torch.utils.flop_counter import FlopCounterMode, conv_flop_count

from backend.estimate import machine
from backend.io import vdb
from backend.physics import neighbours
from backend.physics.solver import Solver
from backend.prior.predict import Prior
from backend.render import splat, voxelize

KINDS: tuple[str, ...] = (
    "kernel_elements",
    "splat_cells",
    "neighbour_visits",
    "prior_operations",
    "voxels_filled",
    "voxels_written",
)


def _convolution(window: Any, weight: Any, *_: Any, out_shape: Any = None, **__: Any) -> int:
    """Operations of oneDNN's convolution, by the shapes of what it is given and gives: torch does not count them by itself."""
    return conv_flop_count(window, weight, out_shape)


_CONVOLUTIONS = {torch.ops.aten.mkldnn_convolution: _convolution}


class Tally:
    """Counts by kind, unless it is paused. Safe for several threads."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = dict.fromkeys(KINDS, 0)
        self.is_paused = False
        self._lock = threading.Lock()

    def add(self, kind: str, count: float) -> None:
        with self._lock:
            self.counts[kind] += 0 if self.is_paused else round(count)


@contextmanager
def counted() -> Iterator[dict[str, int]]:
    """Gives the counts, which grow while this holds."""
    tally = Tally()
    with ExitStack() as stack:
        for function, kind, work in _functions():
            for module, name in _places(function):
                stack.enter_context(mock.patch.object(module, name, _watched(function, tally, kind, work)))
        for module, name in _places(machine.this_machine):
            stack.enter_context(mock.patch.object(module, name, _uncounted(machine.this_machine, tally)))
        for method in (Solver.constrain, Solver.correct):
            watched = _before(method, tally, "neighbour_visits", lambda solver: solver.lists()[1].size)
            stack.enter_context(mock.patch.object(Solver, method.__name__, watched))
        stack.enter_context(mock.patch.object(Prior, "propose", _operations(Prior.propose, tally)))
        stack.enter_context(mock.patch.object(CPUDispatcher, "__call__", _elements(CPUDispatcher.__call__, tally)))
        yield tally.counts


def _functions() -> Iterator[tuple[Callable[..., Any], str, Callable[..., float]]]:
    """Functions, what they count as, and how much from (what they return, *what they take)."""
    yield splat.forward, "splat_cells", lambda drawn, *_, **__: drawn_cells(drawn)
    yield splat.reweighted, "splat_cells", lambda drawn, *_, **__: drawn_cells(drawn)
    yield splat.backward, "splat_cells", lambda _, drawn, *__: drawn_cells(drawn)
    yield splat.adjoint_mass, "splat_cells", lambda _, drawn, *__: drawn_cells(drawn) / len(drawn.image)
    yield neighbours.find_neighbours, "neighbour_visits", lambda found, *_, **__: found.indices.size
    yield voxelize.voxelize, "voxels_filled", lambda _, frame, lattice, **__: filled_voxels(frame, lattice.voxel_size)
    yield vdb.write_vdb, "voxels_written", lambda _, __, grids, **___: sum(np.size(grid) for grid in grids.values())


def drawn_cells(drawn: splat.Splat) -> float:
    """Cells of the boxes of the visible splats, on their own levels, times channels."""
    boxes = drawn.geometry.boxes[drawn.geometry.levels >= 0]
    return float(((boxes[:, 1] - boxes[:, 0] + 1) * (boxes[:, 3] - boxes[:, 2] + 1)).sum()) * len(drawn.image)


def filled_voxels(frame: Any, voxel_size: float) -> float:
    """Voxels of the boxes of all Gaussians."""
    widths = 2.0 * voxelize.splat_extents(frame, voxel_size) / voxel_size
    return float(np.prod(widths + 1.0, axis=1).sum())


def elements_of(value: Any) -> int:
    """Of an array, or of all arrays in a tuple of them."""
    if isinstance(value, np.ndarray):
        return value.size
    return sum(map(elements_of, value)) if isinstance(value, tuple) else 0


def _places(function: Callable[..., Any]) -> list[tuple[Any, str]]:
    """Modules of the backend and of the benchmarks that hold a function, and under which name."""
    modules = [module for name, module in list(sys.modules.items()) if name.partition(".")[0] in ("backend", "benchmarks")]
    found = [(module, name) for module in modules for name, value in vars(module).items() if value is function]
    assert found, function
    return found


def _watched(function: Callable[..., Any], tally: Tally, kind: str, work: Callable[..., float]) -> Callable[..., Any]:
    @functools.wraps(function)
    def watched(*arguments: Any, **options: Any) -> Any:
        result = function(*arguments, **options)
        tally.add(kind, work(result, *arguments, **options))
        return result

    return watched


def _uncounted(function: Callable[..., Any], tally: Tally) -> Callable[..., Any]:
    @functools.wraps(function)
    def watched(*arguments: Any, **options: Any) -> Any:
        tally.is_paused = True
        try:
            return function(*arguments, **options)
        finally:
            tally.is_paused = False

    return watched


def _before(method: Callable[..., Any], tally: Tally, kind: str, work: Callable[[Any], float]) -> Callable[..., Any]:
    @functools.wraps(method)
    def watched(owner: Any, *arguments: Any, **options: Any) -> Any:
        tally.add(kind, work(owner))
        return method(owner, *arguments, **options)

    return watched


def _operations(method: Callable[..., Any], tally: Tally) -> Callable[..., Any]:
    @functools.wraps(method)
    def watched(*arguments: Any, **options: Any) -> Any:
        with FlopCounterMode(display=False, custom_mapping=_CONVOLUTIONS) as counter:  # of this thread alone
            result = method(*arguments, **options)
        tally.add("prior_operations", counter.get_total_flops())
        return result

    return watched


def _elements(call: Callable[..., Any], tally: Tally) -> Callable[..., Any]:
    def watched(kernel: Any, *arguments: Any, **options: Any) -> Any:
        tally.add("kernel_elements", elements_of(arguments))
        return call(kernel, *arguments, **options)

    return watched
