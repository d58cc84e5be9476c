"""The backend check: it finds a Python, asks it in a thread, and says what to do about what it lacks."""

from __future__ import annotations

import shlex
import shutil
import sys
import time
import tomllib
from pathlib import Path

import pytest
from wildsmoke.addon import backend_check
from wildsmoke.addon.backend_check import BackendCheck, find_python, judge, read_requirements, set_up_commands
from wildsmoke.backend.contract.errors import BackendError

CHECKOUT = Path(__file__).resolve().parents[2]
COMMANDS = ("make it", "fill it")
posix_only = pytest.mark.skipif(sys.platform == "win32", reason="scripts with a #! line")


def script(path: Path, text: str) -> str:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(path)


def finding_of(python: str, *, seconds: float = 20.0) -> backend_check.Finding:
    check = BackendCheck(python, CHECKOUT, commands=COMMANDS, seconds=seconds)
    deadline = time.monotonic() + 60
    while (finding := check.poll()) is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return finding


def test_the_real_environment_is_ready():
    finding = finding_of(sys.executable, seconds=100.0)
    assert finding.is_usable, finding.lines
    assert finding.commands == () and all(good for good, _ in finding.lines), finding.lines
    said = [sentence for _, sentence in finding.lines]
    assert said[0].startswith("Python 3.") and any(line.startswith("torch 2.") for line in said) and "C" in said[-1]


def test_asking_does_not_wait():
    began = time.monotonic()
    check = BackendCheck(sys.executable, CHECKOUT, commands=COMMANDS)
    assert check.poll() is None and time.monotonic() - began < 0.5
    check.close()
    began = time.monotonic()
    check.wait()
    assert time.monotonic() - began < 2.0


@posix_only
def test_a_python_without_packages_gets_the_commands(tmp_path):
    bare = script(tmp_path / "python", f'exec {shlex.quote(sys.executable)} -S -E "$@"')
    finding = finding_of(bare)
    assert not finding.is_usable and finding.commands == COMMANDS
    assert (False, "torch is missing") in finding.lines and (False, "rich is missing") in finding.lines


@posix_only
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("echo hello", "is no Python that can be used."),
        ("echo 'cannot execute: wrong format' >&2; exit 126", "It said: cannot execute: wrong format"),
        ("sleep 60", "gave no answer within 0 s"),
    ],
)
def test_what_is_no_python_is_said(tmp_path, text, said):
    finding = finding_of(script(tmp_path / "python", text), seconds=0.3)
    assert not finding.is_usable and said in finding.lines[0][1] and finding.commands == COMMANDS


def test_a_missing_file_and_a_folder_are_said(tmp_path):
    for path in (tmp_path / "nothing", tmp_path):
        finding = BackendCheck(str(path), CHECKOUT, commands=COMMANDS).wait()
        assert not finding.is_usable and "cannot be started" in finding.lines[0][1]


@posix_only
def test_noise_before_the_answer_is_passed_over(tmp_path):
    noisy = script(tmp_path / "python", f"echo 'Welcome!'; exec {shlex.quote(sys.executable)} -S -E \"$@\"")
    assert "Python 3." in finding_of(noisy).lines[0][1]


def report(**changes):
    packages = {"torch": {"version": "2.13.0+cpu", "problem": None}, "numpy": {"version": "2.4.6", "problem": None}}
    return {"python": [3, 12, 1], "packages": packages, "backend": None, "cuda": None} | changes


REQUIREMENTS = {"torch": "2.13.0", "numpy": "2.4.6"}


def judged(**changes):
    return judge(report(**changes), REQUIREMENTS, python="/x/python", commands=COMMANDS)


def test_verdicts_by_hand():
    good = judged()
    assert good.is_usable and (True, "torch 2.13.0+cpu") in good.lines
    assert (True, "No CUDA device: it computes on the CPU") in good.lines
    assert (True, "CUDA: A Card") in judged(cuda="A Card").lines
    old = judged(python=[3, 10, 9])
    assert not old.is_usable and (False, "The backend needs Python 3.11 to 3.13") in old.lines
    assert not judged(python=[3, 14, 0]).is_usable
    packages = {"torch": {"version": "2.13.0", "problem": "OSError: libcudart"}, "numpy": {"version": "2.3.0", "problem": None}}
    broken = judged(packages=packages)
    assert not broken.is_usable and (False, "torch 2.13.0 does not load. OSError: libcudart") in broken.lines
    assert (False, "numpy 2.3.0; 2.4.6 is the tested one") in broken.lines
    assert not judged(backend="ImportError: backend").is_usable


def test_the_python_is_looked_for_in_order(tmp_path):
    with pytest.raises(BackendError) as caught:
        find_python("", home=tmp_path, variables={})
    assert caught.value.code == "backend_not_set"
    inside = "Scripts/python.exe" if sys.platform == "win32" else "bin/python"
    default = tmp_path / "wildsmoke-backend" / inside
    default.parent.mkdir(parents=True)
    default.touch()
    assert find_python("", home=tmp_path, variables={}) == str(default)
    assert find_python(" ", home=tmp_path, variables={"WILDSMOKE_BACKEND_PYTHON": "/a/python"}) == "/a/python"
    assert find_python("/b/python", home=tmp_path, variables={"WILDSMOKE_BACKEND_PYTHON": "/a/python"}) == "/b/python"
    assert find_python(str(tmp_path / "wildsmoke-backend"), home=tmp_path, variables={}) == str(default)


def test_the_commands_can_be_typed_as_they_are():
    root, home = Path("/opt/my add-ons/wildsmoke"), Path("/home/a b")
    make, fill = set_up_commands(root, python="/usr/bin/python3.11", home=home, platform="linux")
    assert shlex.split(make) == ["/usr/bin/python3.11", "-m", "venv", "/home/a b/wildsmoke-backend"]
    assert shlex.split(fill)[1:] == ["-m", "pip", "install", "-r", "/opt/my add-ons/wildsmoke/backend/requirements.txt"]
    make, fill = set_up_commands(root, python="C:\\Python\\python.exe", home=home, platform="win32")
    assert make.startswith('C:\\Python\\python.exe -m venv "') and "Scripts/python.exe" in fill


def test_the_supported_pythons_are_the_projects():
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    oldest, newest = backend_check.OLDEST_PYTHON, backend_check.NEWEST_PYTHON
    assert project["requires-python"] == f">={oldest[0]}.{oldest[1]},<{newest[0]}.{newest[1] + 1}"
    names = {line.partition("==")[0] for line in project["dependencies"]}
    assert set(read_requirements(CHECKOUT)) == names


def test_a_python_for_set_up_is_found_or_blenders_own(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: "/usr/bin/python3.12" if name == "python3.12" else None)
    assert backend_check.python_for_set_up() == "/usr/bin/python3.12"
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert backend_check.python_for_set_up() == sys.executable
    monkeypatch.setattr(backend_check, "NEWEST_PYTHON", (3, 9))
    assert backend_check.python_for_set_up() is None


def test_without_any_python_that_will_do_it_says_so_first():
    first, make, _ = set_up_commands(Path("/opt/x"), python=None, home=Path("/home/a"), platform="linux")
    assert first == "# first install Python 3.11 to 3.13" and make.startswith("python3.13 -m venv")
