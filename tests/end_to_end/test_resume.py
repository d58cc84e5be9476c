"""Killed at any moment, the backend leaves nothing half-written, and the next run ends with the same bytes."""

from __future__ import annotations

import hashlib
import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from backend.io.vdb import openvdb_module
from conftest import backend, backend_command, environment, settings

NUM_KILLS = 20
NOT_COMPARED = {"timing.json", "log.txt", "job.json", "running.json"}


def digest(job: Path) -> dict[str, str]:
    """The content of every file that a job leaves, but for times and the log."""
    files = (path for path in sorted(job.rglob("*")) if path.is_file() and path.name not in NOT_COMPARED)
    return {str(path.relative_to(job)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def assert_whole(job: Path) -> int:
    """Every file under its own name can be read to its end. Returns how many there are."""
    openvdb = openvdb_module()
    assert openvdb is not None
    count = 0
    for path in job.rglob("*"):
        if not path.is_file() or path.suffix == ".part":
            continue
        count += 1
        match path.suffix:
            case ".h5":
                with h5py.File(path, "r") as file:
                    assert "fingerprint" in file.attrs
                    file.visititems(lambda _, item: item[()] if isinstance(item, h5py.Dataset) else None)
            case ".npz":
                with np.load(path) as arrays:
                    assert all(arrays[name].dtype.kind in "fi" for name in arrays.files)
            case ".vdb":
                assert {grid.name for grid in openvdb.readAllGridMetadata(str(path))} >= {"density", "velocity"}
                openvdb.read(str(path), "density")
            case ".json":
                json.loads(path.read_text())
            case ".png":
                assert cv2.imread(str(path)) is not None
    return count


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
            process.wait(timeout=moments.uniform(0.3, 1.0) * seconds)
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
    assert killed_at_work >= NUM_KILLS // 2
    assert checked > 0
    assert backend(*command, "--job", killed).returncode == 0
    leftovers = [path for path in killed.rglob("*.part*")]
    assert not leftovers
    assert digest(killed) == digest(undisturbed)
