"""A whole benchmark scene at the smallest preset: command line, rendering that is killed and goes on, own smoke and scene."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from backend.contract.cameras import read_cameras
from backend.contract.errors import BackendError
from synthetic import __main__ as command_line
from synthetic import record as recording_steps
from synthetic.assemble import assemble
from synthetic.layers import Layer
from synthetic.plan import plan_images
from synthetic.presets import PRESETS

CHECKOUT = Path(__file__).resolve().parents[2]
BLENDER = CHECKOUT / ".venv" / "blender" / "bin" / "python"
TINY = PRESETS["tiny"]


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene's folder with its smoke simulated."""
    folder = tmp_path_factory.mktemp("scene")
    assert recording_steps.main(["simulate", "puff_front", "--out", str(folder), "--preset", "tiny"]) == 0
    return folder


def test_scenes_and_presets_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line.main(["list"]) == 0
    text = capsys.readouterr().out
    for name in ("steady_plume", "puff_front", "wind_wisp", "merging_sources", "obstacle_plume", "paper", "bench", "tiny"):
        assert name in text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["paint"], "no command"),
        (["render", "--blender-python", "/nowhere/python"], "no Python at"),
        (["simulate", "--backend-python", "/nowhere/python"], "no Python at"),
    ],
)
def test_what_the_user_can_mend_is_said(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line.main(arguments) == 2
    assert words in capsys.readouterr().err


def test_an_unknown_scene_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert recording_steps.main(["simulate", "volcano", "--out", str(tmp_path)]) == 2
    assert "volcano" in capsys.readouterr().err


def paint_images(folder: Path) -> None:
    """Grey stand-ins for every image of the tiny preset."""
    for image in plan_images(TINY):
        path = folder / image.path
        path.parent.mkdir(parents=True, exist_ok=True)
        if image.layer is Layer.DEPTH:
            path.write_bytes(b"stand-in")
        else:
            cv2.imwrite(str(path), np.full((TINY.height, TINY.width, 3), 10 * image.frame, np.uint8))
    (folder / "render.json").write_text('{"blender": "none"}')


def test_assembling_ties_the_truth_together(smoke: Path) -> None:
    with pytest.raises(BackendError, match="images of"):
        assemble("puff_front", smoke, TINY)
    paint_images(smoke)
    truth = json.loads(assemble("puff_front", smoke, TINY).read_text(), parse_constant=pytest.fail)
    assert truth["frames"] == {"count": 9, "seen": 8, "fps": 4.0}
    assert truth["simulation"]["scene"]["seed"] == 22
    assert truth["volumes"]["frames"] == [0, 4, 8]
    assert (smoke / "truth" / "volumes" / "volume_0004.vdb").read_bytes() == (smoke / "smoke" / "smoke_0005.vdb").read_bytes()
    readable = sorted(str(path.relative_to(smoke / "input")) for path in (smoke / "input").rglob("*") if path.is_file())
    assert readable == ["clip.mp4", *(f"clip/{frame:04d}.png" for frame in range(8))]
    capture = cv2.VideoCapture(str(smoke / "input" / "clip.mp4"))
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == 8


def start_render(folder: Path, *arguments: str | Path) -> subprocess.Popen[str]:
    if not BLENDER.exists():
        pytest.skip("blender: this Blender wheel is not installed")
    script = CHECKOUT / "synthetic" / "render.py"
    command = [BLENDER, script, "puff_front", "--out", folder, "--preset", "tiny", *arguments]
    return subprocess.Popen([str(part) for part in command], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)


def finish(process: subprocess.Popen[str]) -> str:
    """Wait for a render; its messages."""
    text = process.communicate(timeout=500)[1]
    assert process.returncode == 0, text[-3000:]
    return text


@pytest.mark.blender
@pytest.mark.slow
def test_a_killed_render_goes_on_and_two_workers_share(smoke: Path, tmp_path: Path) -> None:
    common = ("--frames", "3:5", "--views", "input", "--smoke", smoke / "smoke")
    process = start_render(tmp_path, *common)
    end = time.monotonic() + 300
    while not list(tmp_path.rglob("*.part*")) and time.monotonic() < end:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    expected = {tmp_path / image.path for image in plan_images(TINY, views=("input",)) if 3 <= image.frame < 5}
    assert len(expected) == 8
    for path in expected:
        if path.suffix == ".png" and path.exists():
            assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is not None
    assert not all(path.exists() for path in expected)
    for worker in [start_render(tmp_path, *common), start_render(tmp_path, *common)]:
        finish(worker)
    assert all(path.exists() for path in expected)
    made = {path: path.stat().st_mtime_ns for path in expected}
    finish(start_render(tmp_path, *common))
    assert {path: path.stat().st_mtime_ns for path in expected} == made
    assert not list(tmp_path.rglob("*.claim*")) and not list(tmp_path.rglob("*.part*"))
    cameras = read_cameras(tmp_path / "input" / "cameras.json", num_frames=9)
    assert (cameras.width, cameras.height) == (TINY.width, TINY.height)
    smoke_layer = cv2.imread(str(tmp_path / "truth" / "smoke" / "0004.png"), cv2.IMREAD_UNCHANGED)
    assert smoke_layer.dtype == np.uint16 and smoke_layer.shape == (TINY.height, TINY.width, 4)
    assert smoke_layer[..., 3].max() > 0.8 * 65535 and smoke_layer[0, 0].max() == 0
    other = start_render(tmp_path, *common, "--samples", "5")
    assert "other settings" in other.communicate(timeout=300)[1]
    assert other.returncode == 2


@pytest.mark.blender
@pytest.mark.slow
def test_own_scene_and_own_smoke(smoke: Path, tmp_path: Path) -> None:
    if not BLENDER.exists():
        pytest.skip("blender: this Blender wheel is not installed")
    blend = tmp_path / "own.blend"
    lines = (
        "import bpy",
        "bpy.ops.wm.read_factory_settings()",  # a cube, a lamp, a camera
        "bpy.context.scene.world = None",
        f"bpy.ops.wm.save_as_mainfile(filepath={str(blend)!r})",
    )
    subprocess.run([str(BLENDER), "-c", "\n".join(lines)], check=True, capture_output=True)
    order = ("--frames", "4:5", "--views", "side", "--smoke", smoke / "smoke", "--scene", blend)
    finish(start_render(tmp_path / "out", *order))
    plate = cv2.imread(str(tmp_path / "out" / "truth" / "side" / "smoke" / "0004.png"), cv2.IMREAD_UNCHANGED)
    assert plate[..., 3].max() > 0.5 * 65535
    short = tmp_path / "short"
    short.mkdir()
    process = start_render(tmp_path / "other", "--smoke", short)
    assert "0 VDB files for 9 frames" in process.communicate(timeout=300)[1]
    assert process.returncode == 2
