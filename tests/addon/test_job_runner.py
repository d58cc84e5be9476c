"""The job runner against backends that succeed, fail, hang, babble and die."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest
from wildsmoke.addon import job_runner
from wildsmoke.addon.job_runner import Backend, JobRunner, RunState, bounded_lines, group_options
from wildsmoke.addon.job_state import read_tail
from wildsmoke.backend.contract import events
from wildsmoke.backend.contract.errors import BackendError
from wildsmoke.backend.contract.job import Job, read_job
from wildsmoke.backend.contract.running import is_alive

CHECKOUT = Path(__file__).resolve().parents[2]
FAKE_ROOT = Path(__file__).parent / "fake_root"
posix_only = pytest.mark.skipif(os.name == "nt", reason="process groups and /proc of POSIX")


def start(runner: JobRunner, behaviour: str) -> None:
    runner.start(Job(video=f"{behaviour}.mp4", preset="draft"))


def wait_dead(pid: int, seconds: float) -> float:
    """Seconds until a process was gone."""
    began = time.monotonic()
    while is_alive(pid):
        assert time.monotonic() - began < seconds, f"process {pid} lives after {seconds} s"
        time.sleep(0.01)
    return time.monotonic() - began


def test_a_success_gives_its_events_in_order(runner, run_to_end):
    start(runner, "succeed")
    received = run_to_end(runner)
    assert [type(event).event for event in received] == [
        "hello",
        "artifact",
        "stage",
        "stage",
        *["progress"] * 3,
        "warning",
        "done",
    ]
    assert runner.state is RunState.DONE and runner.exit_code == 0
    assert runner.poll() == []
    assert "a line for the log" in runner.log.read_text()
    assert read_job(runner.folder / "job.json").video == "succeed.mp4"


def test_an_error_arrives_with_its_hint(runner, run_to_end):
    start(runner, "error")
    run_to_end(runner)
    assert runner.state is RunState.FAILED
    assert runner.last_event.message == "12 frames; 24 are needed." and runner.last_event.hint == "Trim less of the clip."


def test_noise_is_no_event_and_goes_to_the_log(runner, run_to_end):
    start(runner, "noise")
    received = run_to_end(runner)
    assert [type(event).event for event in received] == ["hello", "done"]
    log = runner.log.read_text(errors="replace")
    assert "[stdout] Downloading weights" in log and "NaN" in log
    assert len(log) < 20_000, "a line of 3 MB must not fill the log"


def test_half_a_line_and_death_is_a_crash_with_its_log(runner, run_to_end):
    start(runner, "half_line")
    run_to_end(runner)
    assert runner.state is RunState.CRASHED and runner.last_event is None
    assert "the reason stands here" in "\n".join(read_tail(runner.log, max_lines=8, start=runner.log_start))


def test_a_flood_neither_loses_the_end_nor_grows(runner, run_to_end):
    start(runner, "flood")
    most, received = 0, 0
    while not runner.state.is_final:
        batch = runner.poll()
        most, received = max(most, len(batch)), received + len(batch)
        assert runner._queue.qsize() <= job_runner.MAX_WAITING_EVENTS
    assert runner.state is RunState.DONE
    assert most <= job_runner.MAX_EVENTS_PER_POLL and received == 30_003


@posix_only
def test_a_flood_nobody_reads_can_be_closed(runner):
    start(runner, "endless_flood")
    time.sleep(0.5)
    pid = runner.pid
    began = time.monotonic()
    runner.close()
    assert time.monotonic() - began < 2.0
    wait_dead(pid, 0.1)


def test_cancel_stops_a_slow_run(runner, run_to_end):
    start(runner, "slow")
    run_to_end(runner, until=lambda: (runner.folder / "running.json").exists())
    runner.cancel()
    assert runner.state is RunState.CANCELLING
    received = run_to_end(runner)
    assert runner.state is RunState.CANCELLED and isinstance(received[-1], events.CancelledEvent)


@posix_only
def test_a_backend_that_ignores_a_cancel_is_ended(runner, run_to_end, monkeypatch):
    monkeypatch.setattr(job_runner, "PATIENCE_AFTER_CANCEL", 0.3)
    start(runner, "deaf")
    pid = runner.pid
    runner.cancel()
    run_to_end(runner, seconds=3.0)
    assert runner.state is RunState.CANCELLED
    wait_dead(pid, 0.1)


@posix_only
@pytest.mark.parametrize("behaviour", ["hang", "deaf_group"])
def test_close_ends_the_whole_group_within_two_seconds(runner, behaviour):
    start(runner, behaviour)
    note = runner.folder / "grandchild.txt"
    deadline = time.monotonic() + 5
    while behaviour == "deaf_group" and not (note.exists() and note.read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    began = time.monotonic()
    pid = runner.pid
    runner.close()
    assert time.monotonic() - began < 2.0
    wait_dead(pid, 0.1)
    if behaviour == "deaf_group":
        wait_dead(int(note.read_text()), 0.5)
    runner.close()  # a second time


@posix_only
def test_close_kills_a_child_that_ignores_terminate(tmp_path, monkeypatch):
    root = tmp_path / "stubborn"
    (root / "backend").mkdir(parents=True)
    (root / "backend/__main__.py").write_text(
        "import signal, time, pathlib\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\npathlib.Path('ready').touch()\ntime.sleep(600)\n"
    )
    stubborn = JobRunner(Backend(python=sys.executable, root=root), tmp_path / "job")
    start(stubborn, "any")
    deadline = time.monotonic() + 5
    while not (root / "ready").exists():
        assert time.monotonic() < deadline
        time.sleep(0.02)
    began = time.monotonic()
    stubborn.close()
    assert time.monotonic() - began < 2.0
    assert stubborn.exit_code == -signal.SIGKILL


@posix_only
@pytest.mark.parametrize("behaviour", ["lingers", "closes_output", "leaves_grandchild"])
def test_what_outlives_its_last_word_is_ended(runner, run_to_end, behaviour, monkeypatch):
    monkeypatch.setattr(job_runner, "PATIENCE_AFTER_LAST", 0.3)
    monkeypatch.setattr(job_runner, "PATIENCE_AFTER_EXIT", 0.3)
    start(runner, behaviour)
    run_to_end(runner, seconds=5.0)
    assert runner.state is (RunState.CRASHED if behaviour == "closes_output" else RunState.DONE)
    wait_dead(runner.pid, 0.1)
    if behaviour == "leaves_grandchild":
        wait_dead(int((runner.folder / "grandchild.txt").read_text()), 0.5)


def test_what_follows_the_last_event_does_not_count(runner, run_to_end):
    start(runner, "after_last")
    received = run_to_end(runner)
    assert isinstance(received[-1], events.Done) and runner.state is RunState.DONE


def test_another_protocol_is_an_error(runner, run_to_end):
    start(runner, "old_protocol")
    received = run_to_end(runner, seconds=5.0)
    assert runner.state is RunState.FAILED
    assert [event.code for event in received if isinstance(event, events.Error)] == ["protocol"]


@posix_only
def test_no_zombie_and_no_open_pipe_remains(runner, run_to_end):
    start(runner, "succeed")
    run_to_end(runner)
    with pytest.raises(ChildProcessError):
        os.waitpid(runner.pid, os.WNOHANG)
    assert runner._process.stdout.closed and runner._process.stdin.closed and not runner._reader.is_alive()
    with warnings.catch_warnings():
        warnings.simplefilter("error", ResourceWarning)
        runner._process = None
        gc.collect()


PARENT = """
import sys, time
from pathlib import Path
sys.path.insert(0, {checkout!r})
import conftest
from wildsmoke.addon.job_runner import Backend, JobRunner
from wildsmoke.backend.contract.job import Job
runner = JobRunner(Backend(python=sys.executable, root=Path({root!r})), Path({folder!r}))
runner.start(Job(video={video!r}))
print(runner.pid, flush=True)
time.sleep(600)
"""


@posix_only
@pytest.mark.parametrize("video", ["slow.mp4", "hang.mp4"])
def test_a_killed_parent_takes_its_backend_along(tmp_path, video):
    code = PARENT.format(checkout=str(CHECKOUT), root=str(FAKE_ROOT), folder=str(tmp_path / "job"), video=video)
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    pid = int(parent.stdout.readline())
    deadline = time.monotonic() + 5
    while not (tmp_path / "job/running.json").exists():
        assert time.monotonic() < deadline
        time.sleep(0.02)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    parent.stdout.close()
    wait_dead(pid, 2.0)


def test_a_missing_python_says_so(tmp_path):
    missing = JobRunner(Backend(python=str(tmp_path / "no_python"), root=FAKE_ROOT), tmp_path / "job")
    with pytest.raises(BackendError) as caught:
        start(missing, "succeed")
    assert caught.value.code == "backend_python_missing" and "Check Backend" in caught.value.hint
    missing.close()


def test_a_file_in_place_of_the_folder_says_so(fake_backend, tmp_path):
    (tmp_path / "job").write_text("in the way")
    with pytest.raises(BackendError) as caught:
        start(JobRunner(fake_backend, tmp_path / "job"), "succeed")
    assert caught.value.code == "folder_unwritable"


@posix_only
def test_a_folder_at_work_takes_no_second_job(runner, fake_backend, run_to_end):
    start(runner, "slow")
    run_to_end(runner, until=lambda: (runner.folder / "running.json").exists())
    with pytest.raises(BackendError) as caught:
        start(JobRunner(fake_backend, runner.folder), "succeed")
    assert caught.value.code == "job_busy" and str(runner.pid) in caught.value.message


def test_a_runner_runs_once(runner, run_to_end):
    start(runner, "succeed")
    run_to_end(runner)
    with pytest.raises(RuntimeError):
        start(runner, "succeed")


def test_a_new_job_ends_the_old_result_and_the_same_job_keeps_it(tmp_path):
    result = tmp_path / "result.json"
    job_runner.write_job(tmp_path, Job(video="a.mp4"))
    result.write_text("{}")
    job_runner.write_job(tmp_path, Job(video="a.mp4"))
    assert result.exists()
    job_runner.write_job(tmp_path, Job(video="a.mp4", preset="final"))
    assert not result.exists() and not list(tmp_path.glob("*.part"))


def test_the_child_gets_a_clean_environment(monkeypatch, fake_backend):
    monkeypatch.setenv("PYTHONHOME", "/somewhere")
    monkeypatch.setenv("PYTHONPATH", "/studio/pipeline")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    environment = fake_backend.environment()
    assert "PYTHONHOME" not in environment and environment["PYTHONPATH"] == str(FAKE_ROOT)
    assert environment["CUDA_VISIBLE_DEVICES"] == "1"


def test_each_platform_makes_a_group():
    assert group_options("linux") == group_options("darwin") == {"start_new_session": True}
    flags = group_options("win32")["creationflags"]
    assert flags & 0x200 and flags & 0x08000000 and "preexec_fn" not in group_options("win32")


def test_bounded_lines_cuts_only_what_is_too_long(tmp_path, monkeypatch):
    monkeypatch.setattr(events, "MAX_LINE_BYTES", 10)
    path = tmp_path / "stream"
    path.write_bytes(b"short\n" + b"y" * 35 + b"\nafter\nhalf")
    with open(path, "rb") as stream:
        assert list(bounded_lines(stream)) == [b"short\n", b"y" * 11, b"after\n", b"half"]
