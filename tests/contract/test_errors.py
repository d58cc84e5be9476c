"""The error for the user, the exit codes, and the mark of a process at work."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from backend.contract import errors, running, units
from backend.contract.errors import BackendError


def test_an_error_says_what_and_how():
    error = BackendError("clip_too_short", "12 frames; 24 are needed.", hint="Trim less of the clip.", stage="frames")
    assert str(error) == "12 frames; 24 are needed. Trim less of the clip."
    assert (error.code, error.stage) == ("clip_too_short", "frames")
    assert BackendError("a", "b.", hint="c.").stage is None


def test_a_hint_is_not_optional():
    with pytest.raises(TypeError):
        BackendError("code", "message")


def test_the_exit_codes_differ():
    assert (errors.EXIT_DONE, errors.EXIT_DEFECT, errors.EXIT_USER) == (0, 1, 2)


def test_a_cancel_is_no_error_for_the_user():
    assert not issubclass(errors.Cancelled, BackendError)


def test_every_format_has_a_version_and_units():
    versions = [value for name, value in vars(units).items() if name.endswith("_VERSION")]
    assert versions and all(isinstance(version, int) and version >= 1 for version in versions)
    assert units.VDB_UNITS["density"] == "1/m" and units.VDB_UNITS["velocity"] == "m/s"


def test_the_contract_needs_the_standard_library_alone():
    code = "import sys; sys.path.insert(0, sys.argv[1]); import backend.contract.job, backend.contract.events\n"
    code += "import backend.contract.cameras, backend.contract.result, backend.contract.running\n"
    code += "assert not {'numpy', 'torch', 'numba', 'h5py', 'rich'} & set(sys.modules)"
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    subprocess.run([sys.executable, "-S", "-E", "-c", code, root], check=True)


def test_a_mark_of_a_process_at_work(tmp_path):
    assert running.running_pid(tmp_path) is None
    running.mark_running(tmp_path)
    assert running.running_pid(tmp_path) == os.getpid() and not list(tmp_path.glob("*.part"))
    running.unmark_running(tmp_path)
    running.unmark_running(tmp_path)
    assert running.running_pid(tmp_path) is None


def test_a_process_that_ended_is_not_at_work(tmp_path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    (tmp_path / "running.json").write_text(json.dumps({"pid": ended.pid, "start": None}))
    assert running.running_pid(tmp_path) is None


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="zombies are told apart through /proc")
def test_a_zombie_is_not_at_work(tmp_path):
    zombie = subprocess.Popen([sys.executable, "-c", ""])
    os.waitid(os.P_PID, zombie.pid, os.WEXITED | os.WNOWAIT)
    assert not running.is_alive(zombie.pid)
    zombie.wait()


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"pid": null}', '{"pid": 1e400}', '{"pid": 99999999999999999999}', '{"pid": NaN}', "[" * 100_000]
)
def test_a_damaged_mark_counts_as_none(tmp_path, text):
    (tmp_path / "running.json").write_text(text)
    assert running.running_pid(tmp_path) is None
