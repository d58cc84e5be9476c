"""Is there a backend? Finds its Python, asks it what it has, and says what to do about what it lacks. Without bpy.

Nothing is ever installed from here, least of all into Blender's Python: the user gets the commands.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..backend.contract.errors import BackendError
from .job_runner import Backend
from .question import Question

OLDEST_PYTHON = (3, 11)
NEWEST_PYTHON = (3, 13)
PYTHON_VARIABLE = "WILDSMOKE_BACKEND_PYTHON"
DEFAULT_FOLDER = "wildsmoke-backend"  # in the home folder: outlives Blender's versions and the extension's updates
CHECK_SECONDS = 120.0  # a first import of torch from a slow disk takes its time
IMPORT_NAMES = {"opencv-python-headless": "cv2"}
_SUPPORTED = f"3.{OLDEST_PYTHON[1]} to 3.{NEWEST_PYTHON[1]}"
_MARK = "WILDSMOKE-CHECK "

PROBE = r"""
import json, sys
report = {"python": list(sys.version_info[:3]), "packages": {}, "backend": None, "cuda": None}
try:
    import importlib, importlib.metadata
    for name, module in json.loads(sys.argv[1]).items():
        entry = {"version": None, "problem": None}
        try:
            entry["version"] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            pass
        try:
            loaded = importlib.import_module(module)
            entry["version"] = entry["version"] or str(getattr(loaded, "__version__", "of unknown version"))
        except (ImportError, OSError, ValueError, AttributeError, RuntimeError, TypeError, SyntaxError) as error:
            entry["problem"] = "%s: %s" % (type(error).__name__, error)
        report["packages"][name] = entry
    try:
        importlib.import_module("backend.contract.job")
    except (ImportError, OSError, SyntaxError) as error:
        report["backend"] = "%s: %s" % (type(error).__name__, error)
    torch = sys.modules.get("torch")
    if torch is not None and hasattr(torch, "cuda") and torch.cuda.is_available():
        report["cuda"] = torch.cuda.get_device_name(0)
except ImportError as error:
    report["backend"] = str(error)
print("WILDSMOKE-CHECK " + json.dumps(report))
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What a check found. lines: (is_good, sentence); commands: what to type where something lacks, else none."""

    is_usable: bool
    lines: tuple[tuple[bool, str], ...]
    commands: tuple[str, ...] = ()


def find_python(preference: str, *, home: Path, variables: Mapping[str, str]) -> str:
    """The backend's Python: of the preferences, of the environment variable, or of ~/wildsmoke-backend.

    A folder is taken for the virtual environment in it. Raises BackendError if there is none.
    """
    chosen = preference.strip() or variables.get(PYTHON_VARIABLE, "").strip()
    if chosen:
        path = Path(os.path.expanduser(chosen))
        return str(_python_inside(path) if path.is_dir() else path)
    default = _python_inside(home / DEFAULT_FOLDER)
    if default.is_file():
        return str(default)
    raise BackendError(
        "backend_not_set",
        "There is no backend yet.",
        hint="Press Check Backend in the add-on's preferences; it says what to type.",
    )


def _python_inside(folder: Path, platform: str = sys.platform) -> Path:
    return folder / ("Scripts/python.exe" if platform == "win32" else "bin/python")


def read_requirements(root: Path) -> dict[str, str]:
    """Package -> pinned version, of backend/requirements.txt."""
    lines = (root / "backend" / "requirements.txt").read_text(encoding="utf-8").splitlines()
    pinned = [line.strip().partition("==") for line in lines if line.strip() and not line.startswith("#")]
    return {name: version for name, _, version in pinned}


def set_up_commands(root: Path, *, python: str | None, home: Path, platform: str = sys.platform) -> tuple[str, ...]:
    """What to type in a terminal to make the backend's environment where the add-on looks for it.

    python: the one to make it with; None where this machine has none that will do.
    """
    if python is None:
        first = f"# first install Python {_SUPPORTED}"
        return first, *set_up_commands(root, python=f"python3.{NEWEST_PYTHON[1]}", home=home, platform=platform)
    folder = home / DEFAULT_FOLDER
    requirements = root / "backend" / "requirements.txt"
    commands = (
        [python, "-m", "venv", str(folder)],
        [str(_python_inside(folder, platform)), "-m", "pip", "install", "-r", str(requirements)],
    )
    if platform == "win32":
        return tuple(subprocess.list2cmdline(words) for words in commands)
    return tuple(shlex.join(words) for words in commands)


def python_for_set_up() -> str | None:
    """A Python on this machine that the backend's packages support; Blender's own can make an environment as well."""
    for minor in range(OLDEST_PYTHON[1], NEWEST_PYTHON[1] + 1):
        found = shutil.which(f"python3.{minor}")
        if found:
            return found
    return sys.executable if OLDEST_PYTHON <= sys.version_info[:2] <= NEWEST_PYTHON else None


def judge(report: Mapping[str, Any], requirements: Mapping[str, str], *, python: str, commands: tuple[str, ...]) -> Finding:
    """A probe's report in sentences."""
    version = tuple(report["python"])
    has_python = OLDEST_PYTHON <= version[:2] <= NEWEST_PYTHON
    lines = [(has_python, f"Python {'.'.join(map(str, version))} at {python}")]
    if not has_python:
        lines.append((False, f"The backend needs Python {_SUPPORTED}"))
    is_usable = has_python
    for name, wanted in requirements.items():
        entry = report["packages"].get(name, {"version": None, "problem": "not probed"})
        has, problem = entry["version"], entry["problem"]
        if problem is None:
            is_same = has.partition("+")[0] == wanted
            lines.append((is_same, f"{name} {has}" if is_same else f"{name} {has}; {wanted} is the tested one"))
            continue
        is_usable = False
        lines.append((False, f"{name} is missing" if has is None else f"{name} {has} does not load. {problem}"))
    if report["backend"] is not None:
        is_usable = False
        lines.append((False, f"The backend itself does not load. {report['backend']}"))
    cuda = report["cuda"]
    lines.append((True, f"CUDA: {cuda}" if cuda else "No CUDA device: it computes on the CPU"))
    return Finding(is_usable=is_usable, lines=tuple(lines), commands=() if is_usable else commands)


class BackendCheck(Question[Finding]):
    """One check of a Python."""

    def __init__(self, python: str, root: Path, *, commands: tuple[str, ...], seconds: float = CHECK_SECONDS) -> None:
        self._commands = commands
        self._requirements = read_requirements(root)
        names = {name: IMPORT_NAMES.get(name, name) for name in self._requirements}
        probe = [python, "-c", PROBE, json.dumps(names)]
        super().__init__(Backend(python=python, root=root), probe, seconds=seconds, read=self._judged, failed=self._unusable)

    def _judged(self, output: bytes, errors: bytes) -> Finding:
        answers = [line for line in output.decode(errors="replace").splitlines() if line.startswith(_MARK)]
        if not answers:
            words = errors.decode(errors="replace").strip().splitlines()
            said = f" It said: {words[-1]}" if words else ""
            return self._unusable(f"{self._python} is no Python that can be used.{said}")
        report = json.loads(answers[-1].removeprefix(_MARK))
        return judge(report, self._requirements, python=self._python, commands=self._commands)

    def _unusable(self, sentence: str) -> Finding:
        return Finding(is_usable=False, lines=((False, sentence),), commands=self._commands)
