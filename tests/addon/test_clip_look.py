"""A look at a clip: its command says all, what comes back is checked, and it never keeps anybody waiting."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest
from wildsmoke.addon.clip_look import ClipLook, inspect_command
from wildsmoke.addon.job_runner import Backend
from wildsmoke.backend.contract.job import Job


def job(behaviour: str, **changes) -> Job:
    return Job(video=f"/clips/{behaviour}.mp4", **changes)


def test_the_command_says_all_that_the_answer_depends_on():
    backend = Backend(python="python", root=Path("/checkout"))
    assert inspect_command(backend, job("a"))[3:] == ["inspect", "/clips/a.mp4", "--json", "--preset", "preview"]
    full = job("a", preset="draft", cameras="/c.json", frame_start=3, frame_stop=40, overrides={"volume.use_prior": False})
    command = inspect_command(backend, full)
    assert command[6:] == ["--preset", "draft", "--cameras", "/c.json", "--frames", "3:40", "--set", "volume.use_prior=False"]
    assert "3:" in inspect_command(backend, job("a", frame_start=3))
    assert "0:9" in inspect_command(backend, job("a", frame_stop=9))


def test_what_the_backend_says_is_read(fake_backend):
    look = ClipLook(fake_backend, job("succeed")).wait()
    assert look.problem == "" and look.outlook is not None
    assert [item.preset for item in look.outlook.estimates] == ["draft", "preview", "final"]
    assert look.outlook.decisions["depth"].value == "silhouette"
    assert (
        look.outlook.estimates[0].to_text() == "draft: 1.3 to 3 min, 0.5 GiB; 32 ± 2 dB in the clip's own view on 5 test scenes"
    )


@pytest.mark.parametrize(("behaviour", "words"), [("error", "Trim less of it."), ("noise", "said nothing")])
def test_a_failure_is_said(fake_backend, behaviour, words):
    look = ClipLook(fake_backend, job(behaviour)).wait()
    assert look.outlook is None and words in look.problem


def test_a_python_that_is_not_there_is_said(fake_backend):
    look = ClipLook(Backend(python="/nowhere/python", root=fake_backend.root), job("succeed")).poll()
    assert look is not None and "cannot be started" in look.problem


def test_it_can_be_ended_early_and_ends_by_itself(fake_backend):
    began = time.monotonic()
    look = ClipLook(fake_backend, job("hang"))
    assert look.poll() is None
    look.close()
    assert look.wait().outlook is None
    late = ClipLook(Backend(python=sys.executable, root=fake_backend.root), job("hang"), seconds=0.2).wait()
    assert "no answer" in late.problem and time.monotonic() - began < 10.0
