"""What the panel says: each event turns one status into the next, whatever the numbers in it."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from wildsmoke.addon.job_runner import RunState
from wildsmoke.addon.job_state import JobKind, JobState
from wildsmoke.addon.status import JobStatus, Phase, after, duration, ended, found, headline, progress_text
from wildsmoke.backend.contract import events

STARTING = JobStatus(phase=Phase.STARTING)
anything = st.one_of(
    st.builds(events.Hello, protocol=st.just(1), version=st.text(), device=st.text()),
    st.builds(events.Stage, name=st.text(), index=st.integers(), count=st.integers(), skipped=st.booleans()),
    st.builds(
        events.Progress,
        stage=st.text(),
        step=st.integers() | st.just(10**400),
        total=st.integers() | st.just(10**401),
        seconds_left=st.none() | st.floats(allow_nan=False, allow_infinity=False) | st.just(10**400),
        job_seconds_left=st.none() | st.floats(allow_nan=False, allow_infinity=False) | st.just(10**400),
    ),
    st.builds(events.Warning, code=st.text(), message=st.text()),
    st.builds(events.Artifact, kind=st.text(), path=st.text()),
    st.builds(events.Error, code=st.text(), message=st.text(), hint=st.text()),
    st.builds(events.CancelledEvent),
    st.builds(events.Done, result=st.text(), seconds=st.floats(allow_nan=False)),
)


def test_progress_by_hand():
    status = after(STARTING, events.Stage(name="physical", index=3, count=7))
    assert status.phase is Phase.RUNNING and math.isclose(status.fraction, 3 / 7)
    status = after(status, events.Progress(stage="physical", step=30, total=120, seconds_left=95.4))
    assert math.isclose(status.fraction, (3 + 0.25) / 7)
    assert headline(status) == "Fitting the motion (4 of 7)"
    assert progress_text(status) == "46 %, 1 min 35 s left in this stage"
    status = after(status, events.Stage(name="visual", index=4, count=7, skipped=True))
    assert math.isclose(status.fraction, 5 / 7) and progress_text(status) == "71 %"
    assert after(status, events.Done(result="result.json", seconds=3.0)).fraction == 1.0


def test_the_time_of_the_whole_job_is_told_where_it_is_known():
    status = after(STARTING, events.Stage(name="physical", index=3, count=6, job_seconds_left=200.0))
    assert progress_text(status) == "50 %, 3 min 20 s left"
    status = after(status, events.Progress(stage="physical", step=1, total=2, seconds_left=20.0, job_seconds_left=95.0))
    assert progress_text(status) == "58 %, 1 min 35 s left"
    assert progress_text(after(status, events.Done(result="result.json", seconds=3.0))) == "100 %"


def test_an_unknown_stage_is_shown_by_its_name():
    assert headline(after(STARTING, events.Stage(name="extra_views", index=0, count=1))) == "Extra views (1 of 1)"


def test_a_cancel_is_not_undone_by_late_progress():
    cancelling = JobStatus(phase=Phase.CANCELLING, stage_count=2)
    assert after(cancelling, events.Progress(stage="visual", step=1, total=2)).phase is Phase.CANCELLING


def test_warnings_are_said_once():
    warning = events.Warning(code="camera_still", message="The camera is taken as still.")
    assert after(after(STARTING, warning), warning).warnings == ("The camera is taken as still.",)


@given(st.lists(anything, max_size=12))
def test_no_numbers_break_it(received):
    status = STARTING
    for event in received:
        status = after(status, event)
        assert 0.0 <= status.fraction <= 1.0
        assert status.seconds_left is None or 0.0 <= status.seconds_left < 1e8
        assert status.job_seconds_left is None or 0.0 <= status.job_seconds_left < 1e8
        assert headline(status) and progress_text(status)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min 00 s"),
        (61, "1 min 01 s"),
        (3599, "59 min 59 s"),
        (3600, "1 h 00 min"),
        (7.5e4, "20 h 50 min"),
    ],
)
def test_durations(seconds, text):
    assert duration(seconds) == text


def test_every_end():
    failed = after(STARTING, events.Error(code="no_smoke", message="No smoke.", hint="Use another clip."))
    options = {"log_tail": ["RuntimeError: out of cheese", "[stdout] half"], "log": "/job/log.txt", "exit_code": -9}
    assert ended(failed, RunState.FAILED, **options).hint == "Use another clip."
    assert ended(STARTING, RunState.DONE, **options).message == ""
    assert ended(STARTING, RunState.CANCELLED, **options).phase is Phase.CANCELLED
    crashed = ended(STARTING, RunState.CRASHED, **options)
    assert "exit code -9" in crashed.message and "out of cheese" in crashed.message and "half" not in crashed.message
    assert "/job/log.txt" in crashed.hint
    assert "Its last words" not in ended(STARTING, RunState.CRASHED, log_tail=[], log="x", exit_code=1).message


def test_every_kind_of_folder_has_its_phase():
    assert {kind: found(JobState(kind=kind, pid=7)).phase for kind in JobKind} == {
        JobKind.NONE: Phase.NONE,
        JobKind.RUNNING: Phase.BUSY,
        JobKind.FINISHED: Phase.DONE,
        JobKind.INTERRUPTED: Phase.INTERRUPTED,
    }
    assert "Process 7" in found(JobState(kind=JobKind.RUNNING, pid=7)).message
