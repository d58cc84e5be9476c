"""Runs check functions inside Blender's wheel, in a process of its own, and gives back how each one ended.

bpy and torch must not meet in one process, and importing bpy takes seconds: so one process a wheel runs all the
`check_*` functions of a file `inside_*.py`, and each is a test here.
"""

from __future__ import annotations

import ast
import functools
import json
import os
import subprocess
import tempfile
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
CHECKOUT = FOLDER.parents[1]
WHEELS = {"bpy45": CHECKOUT / ".venv/blender", "bpy52": CHECKOUT / ".venv/blender52"}
WHEEL_SECONDS = 240


def wheel_python(name: str) -> Path:
    """The Python of a wheel's environment; skips the test where there is none."""
    python = WHEELS[name] / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not python.exists():
        pytest.skip(f"there is no environment {python.parents[1].name} with Blender's wheel")
    return python


def check_names(script: str) -> list[str]:
    """The check functions of a file, without running it."""
    tree = ast.parse((FOLDER / script).read_text(encoding="utf-8"))
    return [node.name for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("check_")]


@functools.cache
def run_checks(script: str, wheel: str) -> dict[str, str | None]:
    """Check name -> None, or the traceback of its failure."""
    with tempfile.TemporaryDirectory(prefix="wildsmoke_") as folder:
        out = Path(folder) / "checks.json"
        home = Path(folder) / "home"
        home.mkdir()
        environment = {**os.environ, "HOME": str(home), "USERPROFILE": str(home), "XDG_CONFIG_HOME": str(home / "config")}
        command = [wheel_python(wheel), FOLDER / "run_checks.py", FOLDER / script, out]
        ended = subprocess.run(
            [str(part) for part in command], env=environment, capture_output=True, text=True, timeout=WHEEL_SECONDS, check=False
        )
        report = json.loads(out.read_text()) if out.exists() else {}
        if ended.returncode != 0:
            report["process"] = f"exit code {ended.returncode}\n{ended.stdout[-3000:]}\n{ended.stderr[-3000:]}"
    return report


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A test with the arguments `wheel` and `check` runs for each check of its module's INSIDE file in each wheel."""
    if {"wheel", "check"} <= set(metafunc.fixturenames):
        metafunc.parametrize("wheel", list(WHEELS))
        metafunc.parametrize("check", check_names(metafunc.module.INSIDE))
    elif "wheel" in metafunc.fixturenames:
        metafunc.parametrize("wheel", list(WHEELS))


@pytest.fixture
def passed(wheel: str, check: str, request: pytest.FixtureRequest) -> bool:
    """Whether a check passed in a wheel; fails with its traceback."""
    report = run_checks(request.module.INSIDE, wheel)
    problem = report.get("process") if check not in report else report[check]
    if problem is not None:
        pytest.fail(problem, pytrace=False)
    return True


@pytest.fixture
def find_wheel_python():
    return wheel_python


@pytest.fixture
def finished_cleanly(request: pytest.FixtureRequest):
    """Whether the process of a wheel came to its end: no hang, no crash when Blender's modules are taken down."""

    def look(wheel: str) -> str | None:
        return run_checks(request.module.INSIDE, wheel).get("process")

    return look
