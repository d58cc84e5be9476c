"""What a run of the backend costs. A process of its own: wall and processor seconds, peak memory, seconds by stage.

Peak memory is what the system counts (ru_maxrss), of the largest of the process and those it waited for. The system counts
from the moment of the fork, so whoever measures here stays small: it loads neither clips nor kernels.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

CHECKOUT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """seconds: wall. cpu_seconds: of all its threads, and of the processes it waited for. stages: wall seconds of each, in
    order; "start" is what passes until the first one. threads: that it may use. load: the machine's load average before.
    is_resumed: part of the work was there already, so that the other figures are of the rest."""

    seconds: float
    cpu_seconds: float
    peak_gib: float
    stages: dict[str, float]
    threads: int
    load: float
    is_resumed: bool = False


def run_backend(*arguments: str | Path) -> Cost:
    """Run a long command of the backend to its end. Raises RuntimeError where it does not come to it, with its own words."""
    load, began = os.getloadavg()[0], time.monotonic()
    command = [sys.executable, "-m", "backend", *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    heard: list[tuple[float, dict[str, Any]]] = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, cwd=CHECKOUT, text=True) as process:
        assert process.stdout is not None
        heard += ((time.monotonic() - began, json.loads(line)) for line in process.stdout)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    last = heard[-1][1] if heard else {}
    if last.get("event") != "done":
        words = last.get("message") or last.get("event") or "it said nothing"
        raise RuntimeError(f"`{arguments[0]}` ended with code {process.returncode}: {words}")
    stages = [(second, event) for second, event in heard if event["event"] == "stage"]
    begins = [0.0, *(second for second, _ in stages)]
    ends = [*begins[1:], heard[-1][0]]
    names = ["start", *(event["name"] for _, event in stages)]
    return Cost(
        seconds=round(time.monotonic() - began, 2),
        cpu_seconds=round(usage.ru_utime + usage.ru_stime, 2),
        peak_gib=round(usage.ru_maxrss / 1024**2, 3),
        stages={name: round(end - begin, 2) for name, begin, end in zip(names, begins, ends, strict=True)},
        threads=int(os.environ.get("NUMBA_NUM_THREADS", len(os.sched_getaffinity(0)))),
        load=round(load, 2),
        is_resumed=any(event["skipped"] for _, event in stages),
    )
