"""A backend that only pretends, and waiting for it."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from wildsmoke.addon.job_runner import Backend, JobRunner
from wildsmoke.backend.contract.events import Event

FAKE_ROOT = Path(__file__).parent / "fake_root"


@pytest.fixture
def fake_backend() -> Backend:
    return Backend(python=sys.executable, root=FAKE_ROOT)


@pytest.fixture
def runner(fake_backend: Backend, tmp_path: Path):
    made = JobRunner(fake_backend, tmp_path / "job")
    yield made
    made.close()


def run_to_end(runner: JobRunner, *, seconds: float = 15.0, until: Callable[[], bool] | None = None) -> list[Event]:
    """Poll as the timer does, until the run is final (or until() holds)."""
    collected: list[Event] = []
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        collected += runner.poll()
        if runner.state.is_final or (until is not None and until()):
            return collected
        time.sleep(0.01)
    raise AssertionError(f"still {runner.state} after {seconds} s; events: {collected[-3:]}")


@pytest.fixture(name="run_to_end")
def run_to_end_fixture():
    return run_to_end
