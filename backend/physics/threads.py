"""As many threads as the work is worth: waking one costs more than a few hundred particles do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numba

_PARTICLES_PER_THREAD = 500


@contextmanager
def threads_for(num_particles: int) -> Iterator[None]:
    """Within: at most one thread for each 500 particles. Results do not depend on the number."""
    before = numba.get_num_threads()
    numba.set_num_threads(min(before, max(1, num_particles // _PARTICLES_PER_THREAD)))
    try:
        yield
    finally:
        numba.set_num_threads(before)
