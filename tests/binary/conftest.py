"""A real Blender binary, and a screen for it. WILDSMOKE_BLENDER names the binary; without it these tests are skipped."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tools import package

CHECKOUT = Path(package.__file__).resolve().parents[1]
SCREEN = "1400x1000x24"


@pytest.fixture(scope="session")
def blender() -> str:
    path = os.environ.get("WILDSMOKE_BLENDER", "")
    if not path:
        pytest.skip("WILDSMOKE_BLENDER names no Blender binary")
    return path


@pytest.fixture(scope="session")
def screen() -> Iterator[str]:
    """The display of the environment, or a virtual one."""
    if os.environ.get("DISPLAY"):
        yield os.environ["DISPLAY"]
        return
    if shutil.which("Xvfb") is None:
        pytest.skip("there is neither a display nor Xvfb")
    readable, writable = os.pipe()
    command = ["Xvfb", "-displayfd", str(writable), "-screen", "0", SCREEN, "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=(writable,), stderr=subprocess.DEVNULL)
    os.close(writable)
    with os.fdopen(readable) as answer:
        number = answer.readline().strip()
    yield f":{number}"
    server.terminate()
    server.wait()


@pytest.fixture(scope="session")
def resources(tmp_path_factory) -> Path:
    """Blender's user folder for these tests, empty at first."""
    return tmp_path_factory.mktemp("blender_user")


@pytest.fixture(scope="session")
def environment(resources: Path) -> dict[str, str]:
    quiet = {"LIBGL_ALWAYS_SOFTWARE": "1", "HOME": str(resources), "BLENDER_USER_RESOURCES": str(resources)}
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    return kept | quiet


@pytest.fixture(scope="session")
def archive(tmp_path_factory) -> Path:
    return package.build(CHECKOUT, tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="session")
def installed(blender: str, environment: dict[str, str], archive: Path) -> Path:
    """The zip, installed and enabled through Blender's extension command line."""
    command = [blender, "--command", "extension", "install-file", "-r", "user_default", "--enable", str(archive)]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return archive


class Gui:
    """One Blender with its window, driven by gui_session.py, which reads a plan and writes what it saw."""

    def __init__(self, blender: str, environment: dict[str, str], screen: str, folder: Path, shots: Path | None) -> None:
        self.folder = folder
        self.report = folder / "report.json"
        self._environment = environment | {"DISPLAY": screen, "WILDSMOKE_GUI_PLAN": str(folder / "plan.json")}
        self._blender = blender
        self._shots = shots
        self.process: subprocess.Popen[bytes] | None = None

    def start(self, blend: Path, **plan: object) -> None:
        """Open a .blend and follow a plan."""
        self.report.unlink(missing_ok=True)
        (self.folder / "plan.json").write_text(json.dumps({"report": str(self.report), **plan}))
        script = Path(__file__).parent / "gui_session.py"
        command = [
            self._blender,
            "--gpu-backend",
            "opengl",
            "--enable-event-simulate",
            "--window-geometry",
            "0",
            "0",
            "1400",
            "1000",
        ]
        command += [str(blend), "--python", str(script)]
        with open(self.folder / "blender.txt", "ab") as log:
            self.process = subprocess.Popen(command, env=self._environment, stdout=log, stderr=subprocess.STDOUT)

    def wait_for(self, key: str, *, seconds: float = 60.0) -> dict:
        """The report, once it has a key. Takes the pictures that the script asks for meanwhile."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self._take_shots()
            report = self._read()
            if key in report:
                return report
            assert self.process.poll() is None, f"Blender ended: {self._tail()}"
            time.sleep(0.05)
        raise AssertionError(f"no {key} within {seconds} s: {self._read()} {self._tail()}")

    def wait_exit(self, *, seconds: float = 30.0) -> dict:
        """The last report, once Blender has ended by itself."""
        deadline = time.monotonic() + seconds
        while self.process.poll() is None:
            assert time.monotonic() < deadline, f"Blender lives after {seconds} s: {self._read()} {self._tail()}"
            self._take_shots()
            time.sleep(0.05)
        return self._read()

    def _read(self) -> dict:
        return json.loads(self.report.read_text()) if self.report.exists() else {}

    def _tail(self) -> str:
        return (self.folder / "blender.txt").read_text(errors="replace")[-3000:]

    def _take_shots(self) -> None:
        for wish in self.folder.glob("*.shot"):
            if self._shots is not None:
                target = self._shots / f"{wish.stem}.png"
                subprocess.run(["import", "-window", "root", str(target)], env=self._environment, check=True, timeout=60)
            wish.unlink()

    def close(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait()


@pytest.fixture
def gui(blender, environment, screen, installed, tmp_path) -> Iterator[Gui]:
    """Blender's window. WILDSMOKE_SCREENSHOTS names a folder for pictures of the panel, taken with ImageMagick."""
    folder = os.environ.get("WILDSMOKE_SCREENSHOTS")
    shots = Path(folder) if folder else None
    if shots is not None:
        shots.mkdir(parents=True, exist_ok=True)
    made = Gui(blender, environment, screen, tmp_path, shots)
    yield made
    made.close()
