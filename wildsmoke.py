"""The one command of a checkout: sets up its environments once, then runs the demo, the tests, or the backend.

    python3 wildsmoke.py demo                 the whole path on the bundled clip
    python3 wildsmoke.py test [pytest args]   lint, types, all tests
    python3 wildsmoke.py package              dist/wildsmoke-<version>.zip for Blender
    python3 wildsmoke.py synth [...]          the synthetic benchmark
    python3 wildsmoke.py bench [...]          speed, memory and accuracy against every setting
    python3 wildsmoke.py <command ...>        the backend's commands: reconstruct, render, export, ...

Standard library only. The backend's environment and Blender's wheel are apart, as on an artist's machine.
"""

from __future__ import annotations

import ctypes.util
import hashlib
import os
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent
DEMO_FOLDER = CHECKOUT / "out" / "demo"
SYSTEM_LIBRARIES = {  # what Blender's wheel loads -> the Debian package that holds it
    "X11": "libx11-6",
    "Xrender": "libxrender1",
    "Xfixes": "libxfixes3",
    "Xi": "libxi6",
    "Xext": "libxext6",
    "xkbcommon": "libxkbcommon0",
    "SM": "libsm6",
    "ICE": "libice6",
    "GL": "libgl1",
}


@dataclass(frozen=True)
class Environment:
    """One virtual environment under .venv/: its Python version and the pinned packages of pyproject.toml."""

    name: str
    python: tuple[int, int]
    groups: tuple[str, ...]
    is_required: bool = True

    @property
    def folder(self) -> Path:
        return CHECKOUT / ".venv" / self.name

    @property
    def interpreter(self) -> Path:
        return self.folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")

    @property
    def stamp(self) -> Path:
        return self.folder / "wildsmoke-setup.txt"


BACKEND = Environment("backend", (3, 11), ("dependencies", "development"))
BLENDER = Environment("blender", (3, 11), ("blender",))
BLENDER_NEWEST = Environment("blender52", (3, 13), ("blender52",), is_required=False)


class SetupError(Exception):
    """One sentence on what is missing and one on what to do."""


def main(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(__doc__)
        return 0
    command, rest = arguments[0], arguments[1:]
    try:
        if command == "demo":
            return demo(rest)
        if command == "test":
            return test(rest)
        if command == "package":
            return run([sys.executable, "-m", "tools.package", *rest])
        if command == "synth":
            set_up(BACKEND, BLENDER)
            return run([BACKEND.interpreter, "-m", "synthetic", *rest], cwd=None)
        if command == "bench":
            set_up(BACKEND, BLENDER)
            return run([BACKEND.interpreter, "-m", "benchmarks.trade", *rest], cwd=None)
        set_up(BACKEND, BLENDER)
        return run([BACKEND.interpreter, "-m", "backend", *arguments], cwd=None)
    except SetupError as error:
        print(f"wildsmoke: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


def demo(arguments: list[str]) -> int:
    """Reconstruct the bundled clip, build the .blend, render the preview, draw the report."""
    set_up(BACKEND, BLENDER)
    return run([BACKEND.interpreter, "-m", "tools.demo", "--blender-python", str(BLENDER.interpreter), *arguments])


def test(arguments: list[str]) -> int:
    """Lint, types and all tests; with arguments, pytest alone."""
    set_up(BACKEND, BLENDER, BLENDER_NEWEST)
    if arguments:
        return run([BACKEND.interpreter, "-m", "pytest", *arguments])
    steps = (
        ["ruff", "check", "."],
        ["ruff", "format", "--check", "."],
        ["pyright"],
        ["pytest"],
    )
    codes = [run([BACKEND.interpreter, "-m", *step]) for step in steps]
    return next((code for code in codes if code), 0)


def run(command: list[str | Path], *, cwd: Path | None = CHECKOUT) -> int:
    """Run a command of the checkout; cwd None keeps the user's folder, so that relative paths mean what they say."""
    environment = dict(os.environ)
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(CHECKOUT), environment.get("PYTHONPATH")]))
    try:
        return subprocess.run([str(part) for part in command], cwd=cwd, env=environment, check=False).returncode
    except KeyboardInterrupt:
        return 130


def set_up(*environments: Environment) -> None:
    """Make what is missing under .venv/. An environment whose packages changed is brought up to date."""
    for environment in environments:
        requirements = read_requirements(environment)
        mark = hashlib.sha256("\n".join(requirements).encode()).hexdigest()
        if environment.stamp.is_file() and environment.stamp.read_text() == mark and environment.interpreter.exists():
            continue
        python = find_python(environment.python)
        if python is None:
            version = ".".join(map(str, environment.python))
            if environment.is_required:
                raise SetupError(f"Python {version} was not found. Install it, so that python{version} is on the PATH.")
            print(f"wildsmoke: python{version} was not found; what needs {' '.join(requirements)} is left out.", file=sys.stderr)
            continue
        print(f"wildsmoke: setting up .venv/{environment.name} (once; some hundred megabytes)", file=sys.stderr, flush=True)
        install(environment, python, requirements)
        environment.stamp.write_text(mark)
    check_system_libraries()


def read_requirements(environment: Environment) -> list[str]:
    """The pinned packages of an environment."""
    with open(CHECKOUT / "pyproject.toml", "rb") as handle:
        project = tomllib.load(handle)["project"]
    groups = {"dependencies": project["dependencies"], **project["optional-dependencies"]}
    return [requirement for group in environment.groups for requirement in groups[group]]


def install(environment: Environment, python: str, requirements: list[str]) -> None:
    """A virtual environment with its packages, through pip."""
    if not environment.interpreter.exists():
        subprocess.run([python, "-m", "venv", "--clear", str(environment.folder)], check=True)
    pip = [str(environment.interpreter), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *requirements]
    if subprocess.run(pip, check=False).returncode != 0:
        raise SetupError(f"pip could not install {', '.join(requirements)}. Read its message above, then run the command again.")


def find_python(version: tuple[int, int]) -> str | None:
    """A Python of this version: this one, one on the PATH, or one of pyenv's."""
    if sys.version_info[:2] == version:
        return sys.executable
    name = f"python{version[0]}.{version[1]}"
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    candidates = [shutil.which(name), *sorted(map(str, pyenv.glob(f"{version[0]}.{version[1]}.*/bin/{name}")))]
    for candidate in filter(None, candidates):
        check = "import sys; print(*sys.version_info[:2])"
        answer = subprocess.run([candidate, "-c", check], capture_output=True, text=True, check=False)
        if answer.stdout.split() == [str(version[0]), str(version[1])]:
            return candidate
    return None


def check_system_libraries() -> None:
    """Blender's wheel needs a few X11 libraries even without a screen: install them where we may, else say how."""
    if not sys.platform.startswith("linux"):
        return
    missing = [package for library, package in SYSTEM_LIBRARIES.items() if ctypes.util.find_library(library) is None]
    if not missing:
        return
    line = f"apt-get install -y --no-install-recommends {' '.join(missing)}"
    is_debian = Path("/etc/debian_version").exists() and shutil.which("apt-get")
    if not (is_debian and os.geteuid() == 0):
        raise SetupError(f"System libraries are missing: {' '.join(missing)}. On Debian or Ubuntu run: sudo {line}")
    print(f"wildsmoke: {line}", file=sys.stderr, flush=True)
    subprocess.run(["apt-get", "update", "-qq"], check=False)
    if subprocess.run(line.split(), stdout=subprocess.DEVNULL, check=False).returncode != 0:
        raise SetupError(f"apt-get failed. Read its message above, then run: {line}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
