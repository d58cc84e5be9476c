"""What an artist will see: the exported volumes as Cycles draws them from the input camera, against the clip's smoke.

Blender is a process of its own, with the add-on's own import of a job. Its pictures are kept, so that a second evaluation
does not draw them again, and one that was interrupted goes on.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from backend.contract.errors import BackendError
from backend.contract.result import Result, read_result
from backend.contract.truth import INPUT_VIEW
from backend.geometry.camera import resized
from backend.io.atomic import storage_errors
from backend.reporting import Report
from backend.score import baselines
from backend.score.compare import OURS
from backend.score.evaluate import Prediction
from backend.score.measures import Target, coded
from backend.score.tally import Tally
from backend.score.truth_set import Truth

_CHECKOUT = Path(__file__).resolve().parents[2]
_SCRIPT = _CHECKOUT / "addon" / "scene" / "build_blend.py"
_VERSION_FILE = "blender.txt"


@dataclass(frozen=True, slots=True, kw_only=True)
class RelightConfig:
    """folder: where pictures are kept. blender: a Python with bpy, or Blender itself. num_frames: drawn, spread evenly over
    the seen ones; samples: of Cycles, a pixel; longest_side: px."""

    folder: Path
    blender: Path
    num_frames: int = 4
    samples: int = 16
    longest_side: int = 320


def find_blender(wanted: Path | None) -> Path:
    """The wanted one; else the Python of the checkout's Blender environment; else Blender on the PATH. Raises BackendError."""
    own = _CHECKOUT / ".venv" / "blender" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    on_path = shutil.which("blender")
    found = wanted or (own if own.is_file() else None) or (Path(on_path) if on_path else None)
    if found is None or not found.is_file():
        raise BackendError(
            "no_blender",
            f"There is no {found}." if found else "Blender was not found.",
            hint="Name Blender, or a Python that has bpy, with --blender; or leave --relight out.",
        )
    return found


def relight_scores(job: Path, prediction: Prediction, truth: Truth, config: RelightConfig, *, report: Report) -> dict[str, Any]:
    """relight: Cycles beside black and grey; relight_particles: the renderer of this program on the same frames and pixels;
    relight_by: which Blender. Raises BackendError where Blender does not come to its end."""
    result = read_result(job)
    places = np.linspace(0, truth.num_seen - 1, config.num_frames + 2)[1:-1]
    frames = sorted({round(place) for place in places})
    folder = drawn(job, result, frames, config, report=report)
    pictures = truth.pictures(INPUT_VIEW)
    tallies = {name: Tally(frames) for name in (OURS, "black", "grey", "particles")}
    size = 0, 0
    for frame in frames:
        layer = _read_layer(folder / _layer_name(result, frame))
        size = layer.shape[1], layer.shape[0]
        real = _at_size(pictures[frame], size)
        view = resized(truth.view(INPUT_VIEW, frame), size)
        target = Target(real)
        tallies[OURS].add(frame, layer, target)
        tallies["particles"].add(frame, prediction.picture(view, frame), target)
        for name in ("black", "grey"):
            tallies[name].add(frame, baselines.trivial_view(name, real, view, view, np.zeros(3)), target)
    found = {name: tally.summary(0) for name, tally in tallies.items()}
    version = folder / _VERSION_FILE
    return {
        "relight": {name: found[name] for name in (OURS, "black", "grey")},
        "relight_particles": found["particles"],
        "relight_by": {
            "program": version.read_text(encoding="utf-8").strip() if version.is_file() else "Blender",
            "samples": config.samples,
            "width": size[0],
            "height": size[1],
        },
    }


def kept_pictures(
    job: Path, truth: Truth, frames: Iterable[str | int], config: RelightConfig
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Frame, Cycles' picture and the true one, both coded [H, W, 3], of frames that were drawn."""
    result = read_result(job)
    folder = _folder(result, config)
    pictures = truth.pictures(INPUT_VIEW)
    for frame in map(int, frames):
        layer = _read_layer(folder / _layer_name(result, frame))
        yield frame, coded(layer), coded(_at_size(pictures[frame], (layer.shape[1], layer.shape[0])))


def drawn(job: Path, result: Result, frames: list[int], config: RelightConfig, *, report: Report) -> Path:
    """The folder with the picture of every frame, after those that were missing were drawn."""
    folder = _folder(result, config)
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    missing = [frame for frame in frames if not (folder / _layer_name(result, frame)).is_file()]
    if missing:
        _draw(job, result, missing, folder, config, report)
    return folder


def _draw(job: Path, result: Result, frames: list[int], folder: Path, config: RelightConfig, report: Report) -> None:
    numbers = ",".join(str(frame - result.frame_start + 1) for frame in frames)
    options = ["--job", job.resolve(), "--layers", folder.resolve(), "--layer-frames", numbers]
    options += ["--samples", config.samples, "--longest-side", config.longest_side]
    is_python = config.blender.stem.startswith("python")
    basis = [] if is_python else ["-b", "--factory-startup", "--python-exit-code", "1", "--python"]
    command = list(map(str, [config.blender, *basis, _SCRIPT, *([] if is_python else ["--"]), *options]))
    report.progress(0, len(frames))
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as words:
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=words, text=True, errors="replace") as process:
            try:
                _follow(process, len(frames), folder, report)
            except BaseException:
                process.kill()  # what it has drawn is kept; a half-drawn picture has another name
                raise
        if process.returncode != 0:
            words.seek(0)
            last = next((line for line in reversed(words.read().splitlines()) if line.strip()), "it said nothing")
            raise BackendError(
                "relight_failed",
                f"Blender ended with code {process.returncode}: {last.strip()}",
                hint="Try the same job with addon/scene/build_blend.py, or leave --relight out.",
            )


def _follow(process: subprocess.Popen[str], count: int, folder: Path, report: Report) -> None:
    """Turn the lines of the other process into progress."""
    assert process.stdout is not None
    step = 0
    for line in process.stdout:
        word, _, rest = line.strip().partition(" ")
        if word == "blender":
            (folder / _VERSION_FILE).write_text(f"Blender {rest}\n", encoding="utf-8")
        elif word == "layer":
            step += 1
            report.progress(step, count)


def _folder(result: Result, config: RelightConfig) -> Path:
    """Pictures of another result or of other settings lie elsewhere."""
    settings = f"{result.fingerprint} {config.samples} {config.longest_side}"
    return config.folder / hashlib.sha256(settings.encode()).hexdigest()[:12]


def _read_layer(path: Path) -> np.ndarray:
    """[H, W, 4] float32 linear premultiplied. Raises BackendError where it was not drawn, or is no picture."""
    try:
        layer = np.load(path)
    except (OSError, ValueError, EOFError) as error:
        raise BackendError(
            "relight_failed", f"{path} cannot be read: {error}.", hint="Delete it and evaluate again; it is drawn anew."
        ) from error
    if layer.ndim != 3 or layer.shape[2] != 4 or not np.isfinite(layer).all():
        raise BackendError("relight_failed", f"{path} is no picture.", hint="Delete it and evaluate again; it is drawn anew.")
    return layer.astype(np.float32)


def _layer_name(result: Result, frame: int) -> str:
    """Blender counts from 1."""
    return f"{frame - result.frame_start + 1:04d}.npy"


def _at_size(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """[H, W, 4] at size (width, height)."""
    same = (picture.shape[1], picture.shape[0]) == size
    return picture if same else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
