"""The supervisor: one run at a time, several folders known, everything ended on close."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from wildsmoke.addon.status import Phase
from wildsmoke.addon.supervisor import Supervisor, as_folder
from wildsmoke.backend.contract import events
from wildsmoke.backend.contract.errors import BackendError
from wildsmoke.backend.contract.job import Job
from wildsmoke.backend.contract.running import is_alive


@pytest.fixture
def supervisor():
    made = Supervisor()
    yield made
    made.close()


def tick_until(supervisor: Supervisor, condition, seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, supervisor._statuses
        supervisor.tick()
        time.sleep(0.01)


def test_a_run_from_start_to_import(supervisor, fake_backend, tmp_path):
    supervisor.start(fake_backend, tmp_path, Job(video="succeed.mp4"))
    assert supervisor.status(tmp_path).phase is Phase.STARTING and supervisor.running_folder == tmp_path
    tick_until(supervisor, lambda: not supervisor.needs_ticks)
    assert supervisor.status(tmp_path).phase is Phase.DONE
    assert "a line for the log" in supervisor.log_lines(tmp_path)
    assert supervisor.take_finished() == [tmp_path] and supervisor.take_finished() == []


def test_what_is_shown_changes_only_with_news(supervisor, fake_backend, tmp_path):
    supervisor.start(fake_backend, tmp_path, Job(video="hang.mp4"))
    tick_until(supervisor, lambda: supervisor.status(tmp_path).device == "cpu" and supervisor.log_lines(tmp_path))
    before = supervisor.shown()
    for _ in range(5):
        supervisor.tick()
    assert supervisor.shown() == before
    supervisor.cancel()
    assert supervisor.shown() != before


def test_only_one_run_at_a_time(supervisor, fake_backend, tmp_path):
    supervisor.start(fake_backend, tmp_path / "a", Job(video="slow.mp4"))
    with pytest.raises(BackendError) as caught:
        supervisor.start(fake_backend, tmp_path / "b", Job(video="succeed.mp4"))
    assert caught.value.code == "job_running"
    assert supervisor.cancel()
    assert supervisor.status(tmp_path / "a").phase is Phase.CANCELLING
    tick_until(supervisor, lambda: supervisor.running_folder is None)
    assert supervisor.status(tmp_path / "a").phase is Phase.CANCELLED and not supervisor.cancel()
    supervisor.start(fake_backend, tmp_path / "b", Job(video="succeed.mp4"))
    tick_until(supervisor, lambda: supervisor.running_folder is None)
    assert supervisor.status(tmp_path / "b").phase is Phase.DONE


def test_a_start_that_fails_is_shown(supervisor, fake_backend, tmp_path):
    (tmp_path / "job").write_text("in the way")
    with pytest.raises(BackendError):
        supervisor.start(fake_backend, tmp_path / "job", Job(video="succeed.mp4"))
    status = supervisor.status(tmp_path / "job")
    assert status.phase is Phase.FAILED and "cannot be written to" in status.message and status.hint
    assert supervisor.running_folder is None


def test_looking_does_not_disturb_our_own_run(supervisor, fake_backend, tmp_path):
    supervisor.start(fake_backend, tmp_path, Job(video="slow.mp4"))
    tick_until(supervisor, lambda: supervisor.status(tmp_path).phase is Phase.RUNNING)
    assert supervisor.look(tmp_path).phase is Phase.RUNNING


def test_a_second_blender_sees_the_first_one_at_work(supervisor, fake_backend, tmp_path):
    supervisor.start(fake_backend, tmp_path, Job(video="slow.mp4"))
    tick_until(supervisor, lambda: (tmp_path / "running.json").exists())
    other = Supervisor()
    assert other.look(tmp_path).phase is Phase.BUSY and other.needs_ticks
    with pytest.raises(BackendError) as caught:
        other.start(fake_backend, tmp_path, Job(video="slow.mp4"))
    assert caught.value.code == "job_busy"
    other.look(tmp_path)
    supervisor.close()
    other._next_look = 0.0
    other.tick()
    assert other.status(tmp_path).phase is Phase.INTERRUPTED and not other.needs_ticks


def test_close_ends_the_run(supervisor, fake_backend, tmp_path):
    supervisor.start(fake_backend, tmp_path, Job(video="hang.mp4"))
    pid = supervisor.runner.pid
    began = time.monotonic()
    supervisor.close()
    assert time.monotonic() - began < 2.0 and not is_alive(pid)
    supervisor.close()


def test_waiting_for_the_end_as_in_background_mode(supervisor, fake_backend, tmp_path):
    seen: list[events.Event] = []
    supervisor.start(fake_backend, tmp_path, Job(video="succeed.mp4"))
    assert supervisor.run_to_end(seen.append).phase is Phase.DONE
    assert isinstance(seen[0], events.Hello) and isinstance(seen[-1], events.Done)


def test_an_interrupt_while_waiting_ends_the_child(supervisor, fake_backend, tmp_path):
    def interrupt(event: events.Event) -> None:
        raise KeyboardInterrupt

    supervisor.start(fake_backend, tmp_path, Job(video="slow.mp4"))
    pid = supervisor.runner.pid
    with pytest.raises(KeyboardInterrupt):
        supervisor.run_to_end(interrupt)
    assert not is_alive(pid)


def test_an_error_of_the_import_stands_beside_the_finished_job(supervisor, fake_backend, tmp_path):
    supervisor.start(fake_backend, tmp_path, Job(video="succeed.mp4"))
    tick_until(supervisor, lambda: supervisor.running_folder is None)
    supervisor.note(tmp_path, BackendError("vdb_missing", "A VDB file is missing.", hint="Run the job again."))
    status = supervisor.status(tmp_path)
    assert status.phase is Phase.DONE and status.message == "A VDB file is missing."


def test_one_spelling_for_each_folder(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert as_folder("a/../b/") == as_folder(tmp_path / "b") == Path(tmp_path / "b")
    assert as_folder("~/x") == Path.home() / "x"
