"""Seconds that a piece of work takes, as far as that can be told on a machine that may be busy with something else."""

from __future__ import annotations

import time


class Stopwatch:
    """Runs from when it is made. Of several threads the wall tells, beside other programs the processor: the lesser counts."""

    def __init__(self) -> None:
        self._wall, self._processor = time.perf_counter(), time.process_time()

    def seconds(self) -> float:
        return min(time.perf_counter() - self._wall, time.process_time() - self._processor)
