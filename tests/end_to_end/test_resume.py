"""Killed at any moment, the backend leaves nothing half-written, and the next run ends with the same bytes."""

from __future__ import annotations

import random
import signal
import subprocess
import time
from pathlib import Path

import pytest
from small_job import assert_whole, backend, backend_command, digest, environment, settings

NUM_KILLS = 20


@pytest.mark.slow
def test_twenty_kills_leave_the_same_bytes(plume: Path, tmp_path: Path) -> None:
    undisturbed, killed = tmp_path / "undisturbed", tmp_path / "killed"
    command = ("reconstruct", plume, *settings())
    assert backend(*command, "--job", tmp_path / "warm").returncode == 0  # compiles the kernels
    began = time.monotonic()
    assert backend(*command, "--job", undisturbed).returncode == 0
    seconds = time.monotonic() - began

    moments = random.Random(20)
    checked = killed_at_work = 0
    for _ in range(NUM_KILLS):
        process = subprocess.Popen(
            backend_command(*command, "--job", killed), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment()
        )
        try:
            process.wait(timeout=moments.uniform(0.2, 0.7) * seconds)  # what goes on has less to do
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            killed_at_work += 1
        if killed.exists():
            checked += assert_whole(killed)
        if (killed / "result.json").exists():
            for path in killed.rglob("*"):  # begin again, so that later kills meet unfinished work too
                if path.is_file() and path.name in ("result.json", "visual.h5", "particles.h5"):
                    path.unlink()
    assert killed_at_work >= NUM_KILLS // 2, f"{killed_at_work} of {NUM_KILLS} met a job at work"
    assert checked > 0
    assert backend(*command, "--job", killed).returncode == 0
    leftovers = [path for path in killed.rglob("*.part*")]
    assert not leftovers
    assert digest(killed) == digest(undisturbed)
