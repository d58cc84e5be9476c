"""A reconstruction against the truth: views it never saw, frames it never saw, the volume, the velocity; beside it what
trivial answers get on the same pictures, and the volumes of a prior that treats every frame by itself.

Means of decibels are over frames, each at most 50 dB; `global_db` is that of the mean squared error of all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from backend.contract.truth import INPUT_VIEW
from backend.geometry.camera import View
from backend.score import baselines, measures
from backend.score.truth_set import TruthSet, Volume

THIRDS = ("first", "middle", "last")
FUTURE_VIEWS = (INPUT_VIEW, "nvs")


class Volumes(Protocol):
    """Volumes that are scored, by video frame."""

    def volume(self, like: Volume, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Density [X, Y, Z] 1/m and velocity [X, Y, Z, 3] m/s on the voxels of `like`."""
        ...


class Prediction(Volumes, Protocol):
    """What is scored. Frames are video frames; those from num_seen on are a forecast."""

    num_frames: int

    def picture(self, view: View, frame: int) -> np.ndarray:
        """[H, W, 4] linear premultiplied light and opacity."""
        ...


Answer = Callable[[int], np.ndarray]  # video frame -> [H, W, 4]


@dataclass
class _Errors:
    """Squared errors of one answer by frame."""

    frames: list[int] = field(default_factory=list)
    full: list[float] = field(default_factory=list)
    smoke: list[float] = field(default_factory=list)

    def add(self, frame: int, picture: np.ndarray, truth: np.ndarray) -> None:
        full, smoke = measures.squared_errors(picture, truth)
        self.frames.append(frame)
        self.full.append(full)
        self.smoke.append(smoke)

    def summary(self, num_seen: int) -> dict[str, Any]:
        """Means over all frames, and over each third of num_seen frames; 0: they are none of these."""
        full = [measures.decibels(error) for error in self.full]
        smoke = [measures.decibels(error) for error in self.smoke if not np.isnan(error)]
        found: dict[str, Any] = {"full_db": _mean(full), "global_db": _rounded(measures.decibels(float(np.mean(self.full))))}
        found["smoke_db"] = _mean(smoke)
        for third, name in enumerate(THIRDS if num_seen else ()):
            part = [value for frame, value in zip(self.frames, full, strict=True) if 3 * frame // num_seen == third]
            found[f"{name}_db"] = _mean(part)
        found["by_frame_db"] = {str(frame): _rounded(value) for frame, value in zip(self.frames, full, strict=True)}
        return found


def evaluate(
    prediction: Prediction,
    truth: TruthSet,
    *,
    anchor: np.ndarray,  # [3] m: where billboards stand
    prior: Volumes | None = None,
) -> dict[str, Any]:
    """All scores of one reconstruction. Nothing is rounded before it is averaged."""
    seen = truth.pictures(INPUT_VIEW)
    scores: dict[str, Any] = {"scene": truth.name}
    future: dict[str, Any] = {}
    for view, frames in truth.frames.items():
        targets = dict(zip(frames, seen if view == INPUT_VIEW else truth.pictures(view), strict=True))
        asked = [frame for frame in frames if frame < prediction.num_frames]
        shown = {frame: prediction.picture(truth.view(view, frame), frame) for frame in asked}
        past = [frame for frame in asked if frame < truth.num_seen]
        ahead = [frame for frame in asked if frame >= truth.num_seen]
        still = np.mean([shown[frame] for frame in past], axis=0)
        ours: dict[str, Answer] = {"ours": shown.__getitem__, "still mean": lambda frame, still=still: still}
        answers = ours | _trivial(truth, view, seen, anchor)
        if view == INPUT_VIEW:  # where a copy is the truth itself
            answers = {name: answers[name] for name in ("ours", "black", "grey")}
        scores[view] = {name: _errors(answer, past, targets).summary(truth.num_seen) for name, answer in answers.items()}
        if ahead and view in FUTURE_VIEWS:
            answers = ours | _frozen(prediction, truth, view, seen, anchor)
            future[f"future_{view}"] = {name: _errors(answer, ahead, targets).summary(0) for name, answer in answers.items()}
    scores |= future
    scores["volume"] = _volumes(prediction, truth)
    if prior is not None:
        scores["prior_volume"] = _volumes(prior, truth)
    return scores


def table(scores: dict[str, Any]) -> str:
    """The figures as text: a row for each view and answer."""
    lines = [
        f"{scores['scene']:<14} {'answer':<22} {'dB full':>8} {'smoke':>7} {'first':>7} {'middle':>7} {'last':>7} {'global':>7}"
    ]
    keys = ("full_db", "smoke_db", "first_db", "middle_db", "last_db", "global_db")
    for view, answers in scores.items():
        if not (isinstance(answers, dict) and "ours" in answers):
            continue
        for answer, found in answers.items():
            numbers = [found.get(key) for key in keys]
            cells = ["-" if number is None else f"{number:.2f}" for number in numbers]
            lines.append(f"{view:<14} {answer:<22} {cells[0]:>8} " + " ".join(f"{cell:>7}" for cell in cells[1:]))
    for name in ("volume", "prior_volume", "divergence", "buoyancy"):
        found = scores.get(name, {})
        figures = {key: value for key, value in found.items() if key != "velocity"} | found.get("velocity", {})
        lines += [f"{name:<14} {key} {value}" for key, value in figures.items()]
    return "\n".join(lines)


def _trivial(truth: TruthSet, view: str, seen: np.ndarray, anchor: np.ndarray) -> dict[str, Answer]:
    """What needs no reconstruction, from the input picture of the same moment."""

    def answer(frame: int, name: str) -> np.ndarray:
        return baselines.trivial_view(name, seen[frame], truth.view(INPUT_VIEW, frame), truth.view(view, frame), anchor)

    return {name: lambda frame, name=name: answer(frame, name) for name in baselines.TRIVIAL}


def _frozen(prediction: Prediction, truth: TruthSet, view: str, seen: np.ndarray, anchor: np.ndarray) -> dict[str, Answer]:
    """What needs no forecast: our last seen moment held still, and trivial answers from the last seen picture."""
    last = truth.num_seen - 1

    def answer(frame: int, name: str) -> np.ndarray:
        return baselines.trivial_view(name, seen[last], truth.view(INPUT_VIEW, last), truth.view(view, frame), anchor)

    names = {name: name if name in ("black", "grey") else f"frozen {name}" for name in baselines.TRIVIAL}
    return {"frozen reconstruction": lambda frame: prediction.picture(truth.view(view, frame), last)} | {
        title: lambda frame, name=name: answer(frame, name) for name, title in names.items()
    }


def _errors(answer: Answer, frames: list[int], targets: dict[int, np.ndarray]) -> _Errors:
    errors = _Errors()
    for frame in frames:
        errors.add(frame, answer(frame), targets[frame])
    return errors


def _volumes(prediction: Volumes, truth: TruthSet) -> dict[str, Any]:
    """Means over the seen moments that hold smoke. mass_ratio: our optical mass over the true one, of all moments."""
    rows: list[dict[str, float]] = []
    velocities: list[dict[str, float]] = []
    masses = np.zeros(2)
    for frame in truth.volume_frames():
        real = truth.volume(frame)
        if frame >= truth.num_seen or real.density.max() < 0.05:
            continue
        density, velocity = prediction.volume(real, frame)
        rows.append(
            {
                "correlation": measures.correlation(density, real.density),
                "relative_l2": measures.relative_l2(density, real.density),
            }
        )
        masses += density.sum(dtype=np.float64), real.density.sum(dtype=np.float64)
        if real.velocity is not None and frame > 0:
            axes = camera_axes(truth.view(INPUT_VIEW, frame))
            velocities.append(measures.velocity_scores(velocity, real.velocity, real.density, axes))
    found: dict[str, Any] = {name: _mean([row[name] for row in rows]) for name in rows[0]} if rows else {}
    found["mass_ratio"] = _rounded(float(masses[0] / masses[1])) if masses[1] > 0 else None
    if velocities:
        found["velocity"] = {name: _mean([row[name] for row in velocities]) for name in velocities[0]}
    return found


def camera_axes(view: View) -> np.ndarray:
    """[3, 3] rows: sideways in the image, up in the world (z), away from the camera; the first and last level."""
    away = view.camera_to_world[:3, 2] * (1.0, 1.0, 0.0)
    away = away / np.linalg.norm(away)
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([np.cross(away, up), up, away])


def _mean(values: list[float]) -> float | None:
    found = [value for value in values if not np.isnan(value)]
    return _rounded(float(np.mean(found))) if found else None


def _rounded(value: float) -> float:
    return round(value, 4)
