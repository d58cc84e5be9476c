"""Finding a job again: none, running, finished, interrupted; and the end of its log."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from wildsmoke.addon import job_state
from wildsmoke.addon.job_state import JobKind, JobState, read_tail
from wildsmoke.backend.contract.job import Job
from wildsmoke.backend.contract.running import process_start

RESULT = {
    "format_version": 1,
    "particles": "particles.h5",
    "cameras": "cameras.json",
    "vdb_folder": "vdb",
    "num_frames": 3,
    "num_forecast": 0,
    "frame_start": 0,
    "fps": 24.0,
    "voxel_size": 0.1,
    "has_color": False,
    "smoke_color": [0.8, 0.8, 0.8],
    "bounds": [[-1.0, -1.0, 0.0], [1.0, 1.0, 2.0]],
    "buoyancy": [0.0, 0.0, 1.0],
}


@pytest.fixture
def job(tmp_path) -> Path:
    (tmp_path / "job.json").write_text(Job(video="a.mp4").to_json())
    return tmp_path


def mark(folder: Path, pid: int, start: str | None) -> None:
    (folder / "running.json").write_text(json.dumps({"pid": pid, "start": start}))


def test_no_folder_and_an_empty_folder_hold_no_job(tmp_path):
    assert JobState.find(tmp_path / "nowhere").kind is JobKind.NONE
    assert JobState.find(tmp_path).kind is JobKind.NONE


def test_a_job_without_a_result_was_interrupted(job):
    assert JobState.find(job) == JobState(kind=JobKind.INTERRUPTED)


def test_a_result_makes_it_finished(job):
    (job / "result.json").write_text(json.dumps(RESULT))
    assert JobState.find(job).kind is JobKind.FINISHED


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format_version": 1}', '{"format_version": 99}', "\x00"])
def test_a_damaged_result_is_no_result(job, text):
    (job / "result.json").write_text(text)
    state = JobState.find(job)
    assert state.kind is JobKind.INTERRUPTED and "cannot be read" in state.problem


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"format_version": 1, "video": 3}'])
def test_a_damaged_job_is_said(tmp_path, text):
    (tmp_path / "job.json").write_text(text)
    state = JobState.find(tmp_path)
    assert state.kind is JobKind.INTERRUPTED and state.problem


def test_a_living_process_is_running_until_it_ends(job):
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    mark(job, process.pid, process_start(process.pid))
    assert JobState.find(job) == JobState(kind=JobKind.RUNNING, pid=process.pid)
    process.communicate(b"\n")
    assert JobState.find(job).kind is JobKind.INTERRUPTED


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="the system does not tell when a process began")
def test_a_number_used_again_is_not_our_process(job):
    mark(job, os.getpid(), "1")
    assert JobState.find(job).kind is JobKind.INTERRUPTED


@pytest.mark.parametrize("text", ["", "{}", '{"pid": "x"}', '{"pid": -1}', '{"pid": 0}', "[3]"])
def test_a_damaged_mark_counts_as_none(job, text):
    (job / "running.json").write_text(text)
    assert JobState.find(job).kind is JobKind.INTERRUPTED


def test_the_tail_of_a_log(tmp_path, monkeypatch):
    log = tmp_path / "log.txt"
    assert read_tail(log, max_lines=3) == []
    log.write_bytes(b"old run\n" + b"one\n\ntwo \xff\nthree\nfour")
    assert read_tail(log, max_lines=3) == ["two \ufffd", "three", "four"]
    assert read_tail(log, max_lines=9, start=8) == ["one", "two \ufffd", "three", "four"]
    assert read_tail(log, max_lines=9, start=10_000)[0] == "old run", "the log was emptied since"
    monkeypatch.setattr(job_state, "MAX_TAIL_BYTES", 13)
    assert read_tail(log, max_lines=9) == ["three", "four"], "a line cut at its beginning is left out"
