"""Speed of the fluid: wall milliseconds of a step, its gradient, neighbour lists, interpolation and smoothing. JSON on stdout.

    python -m benchmarks.physics_speed [--particles 1000 10000] [--repeats 20] [--threads N]

Best and median of the repeats are printed, with the processor time of the best: on a busy machine the wall time says
more about the neighbours. A random cloud that has settled for five steps, moving sideways and rising, three iterations.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numba
import numpy as np

from backend.physics.fluid import FluidParameters, FluidState, derive_parameters, step
from backend.physics.fluid_gradient import rollout
from backend.physics.interpolate import interpolate_velocity, smooth
from backend.physics.neighbours import find_neighbours
from backend.physics.threads import threads_for

SECONDS = 1.0 / 24.0


def settled_cloud(num: int) -> tuple[FluidState, FluidParameters]:
    """A cloud of one particle per unit volume, five steps old."""
    random = np.random.default_rng(0)
    state = FluidState(
        positions=num ** (1.0 / 3.0) * random.random((num, 3)),
        velocities=np.broadcast_to([0.5, 0.0, 0.0], (num, 3)).copy(),
        masses=np.ones(num),
        ids=np.arange(num),
        born=np.zeros(num, np.int32),
    )
    parameters = derive_parameters(state.positions, drag=0.5)
    parameters = replace(parameters, buoyancy=(0.0, 0.0, 1.0))
    for _ in range(5):
        state, _ = step(state, parameters, SECONDS)
    return state, parameters


def timed(work: Callable[[], object], repeats: int) -> dict[str, float]:
    """Milliseconds. processor: of all threads together, in the repeat that took least of it."""
    work()
    walls, processor = [], []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        walls.append(1e3 * (time.perf_counter() - wall))
        processor.append(1e3 * (time.process_time() - cpu))
    rounded = {"best": min(walls), "median": statistics.median(walls), "processor": min(processor)}
    return {name: round(value, 3) for name, value in rounded.items()}


def measure(num: int, repeats: int) -> dict[str, object]:
    """Timings of one number of particles."""
    state, parameters = settled_cloud(num)
    length = parameters.smoothing_length
    points = state.positions + 0.1 * length

    def lists() -> None:
        with threads_for(num):
            find_neighbours(state.positions, 1.1 * length)

    moved = rollout(state, parameters, SECONDS)
    gradients = [None, moved.states[1].positions]
    return {
        "particles": num,
        "step_ms": timed(lambda: step(state, parameters, SECONDS), repeats),
        "recorded_step_ms": timed(lambda: rollout(state, parameters, SECONDS), repeats),
        "step_backward_ms": timed(lambda: moved.backward(gradients), repeats),
        "tape_mib": round(moved.num_bytes / 2**20, 2),
        "substeps": moved.reports[0].substeps,
        "neighbours_ms": timed(lists, repeats),
        "interpolate_ms": timed(lambda: interpolate_velocity(points, state, length), repeats),
        "smooth_ms": timed(lambda: smooth(state.velocities, state, length), repeats),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--particles", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--threads", type=int, default=numba.config.NUMBA_NUM_THREADS)
    arguments = parser.parse_args()
    numba.set_num_threads(arguments.threads)
    result = {
        "benchmark": "physics_speed",
        "machine": platform.machine(),
        "threads": arguments.threads,
        "cores": os.cpu_count(),
        "load_average": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "results": [measure(num, arguments.repeats) for num in arguments.particles],
    }
    json.dump(result, sys.stdout, indent=2, allow_nan=False)
    print()


if __name__ == "__main__":
    main()
