"""What a long run says: how much is done, what is left, what it will cost. Plain lines, as Blender's Python has no more."""

from __future__ import annotations

import sys
import time

_SECONDS_BETWEEN_LINES = 10.0


class Progress:
    """Counts steps and tells the time left from the mean of those made in this run, but for the first: that one includes
    a warm-up or a scene that is loaded."""

    def __init__(self, *, label: str, total: int, done: int = 0) -> None:
        self._label, self._total, self._done = label, total, done
        self._made = 0
        self._begin: float | None = None
        self._said = float("-inf")

    def step(self, *, is_made: bool = True) -> None:
        """One more is done; is_made False: another worker or an earlier run made it."""
        self._done += 1
        now = time.monotonic()
        if self._begin is not None:
            self._made += is_made
        elif is_made:
            self._begin = now
        is_last = self._done == self._total
        if not (is_last or sys.stderr.isatty()) and now - self._said < _SECONDS_BETWEEN_LINES:
            return
        self._said = now
        left = ""
        if self._made and self._begin is not None and not is_last:
            left = f", {duration((now - self._begin) / self._made * (self._total - self._done))} left"
        line = f"{self._label}: {self._done}/{self._total}{left}"
        if sys.stderr.isatty():
            print(f"\r{line:<70}", end="\n" if is_last else "", file=sys.stderr, flush=True)
        else:
            print(line, file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """12 s, 3.4 min, 5.6 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h"
