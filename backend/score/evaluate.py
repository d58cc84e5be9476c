"""A reconstruction against the truth: views it never saw, frames it never saw, the volume, the velocity, and what trivial
answers get on the same pictures.

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


class Prediction(Protocol):
    """What is scored. Frames are video frames; those from num_seen on are a forecast."""

    num_frames: int

    def picture(self, view: View, frame: int) -> np.ndarray:
        """[H, W, 4] linear premultiplied light and opacity."""
        ...

    def volume(self, like: Volume, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Density [X, Y, Z] 1/m and velocity [X, Y, Z, 3] m/s on the voxels of `like`."""
        ...


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
        full = [measures.decibels(error) for error in self.full]
        smoke = [measures.decibels(error) for error in self.smoke if not np.isnan(error)]
        found: dict[str, Any] = {"full_db": _mean(full), "global_db": _rounded(measures.decibels(float(np.mean(self.full))))}
        found["smoke_db"] = _mean(smoke)
        for third, name in enumerate(THIRDS):
            part = [value for frame, value in zip(self.frames, full, strict=True) if 3 * frame // max(num_seen, 1) == third]
            found[f"{name}_db"] = _mean(part)
        found["by_frame_db"] = {str(frame): _rounded(value) for frame, value in zip(self.frames, full, strict=True)}
        return found


def evaluate(prediction: Prediction, truth: TruthSet, *, anchor: np.ndarray) -> dict[str, Any]:
    """All scores of one reconstruction; anchor [3] m: where billboards stand. Nothing is rounded before it is averaged."""
    seen_pictures = truth.pictures(INPUT_VIEW)
    scores: dict[str, Any] = {"scene": truth.name, "input": _input_view(prediction, truth, seen_pictures)}
    for view in truth.frames:
        if view != INPUT_VIEW:
            scores[view] = _other_view(prediction, truth, view, seen_pictures, anchor)
    if prediction.num_frames > truth.num_seen:
        scores["future_input"] = _future(prediction, truth, INPUT_VIEW, seen_pictures)
        scores["future_nvs"] = _future(prediction, truth, "nvs", seen_pictures)
    scores["volume"] = _volumes(prediction, truth)
    return scores


def table(scores: dict[str, Any]) -> str:
    """The figures as text: a row for each view and answer."""
    lines = [
        f"{scores['scene']:<14} {'answer':<22} {'dB full':>8} {'smoke':>7} {'first':>7} {'middle':>7} {'last':>7} {'global':>7}"
    ]
    keys = ("full_db", "smoke_db", "first_db", "middle_db", "last_db", "global_db")
    for view, answers in scores.items():
        if not isinstance(answers, dict) or view == "volume":
            continue
        for answer, found in answers.items():
            numbers = [found.get(key) for key in keys]
            cells = ["-" if number is None else f"{number:.2f}" for number in numbers]
            lines.append(f"{view:<14} {answer:<22} {cells[0]:>8} " + " ".join(f"{cell:>7}" for cell in cells[1:]))
    volume = scores["volume"]
    lines += [f"volume         {name} {volume[name]}" for name in ("correlation", "relative_l2", "mass_ratio") if name in volume]
    lines += [f"velocity       {name} {value}" for name, value in volume.get("velocity", {}).items()]
    return "\n".join(lines)


def best_trivial(scores: dict[str, dict[str, Any]], figure: str) -> tuple[str, float]:
    """Name and value of the trivial answer that has most of a figure."""
    names = [name for name in scores if name != "ours" and scores[name].get(figure) is not None]
    best = max(names, key=lambda name: scores[name][figure])
    return best, float(scores[best][figure])


def _input_view(prediction: Prediction, truth: TruthSet, pictures: np.ndarray) -> dict[str, Any]:
    ours = _Errors()
    for frame in range(truth.num_seen):
        ours.add(frame, prediction.picture(truth.view(INPUT_VIEW, frame), frame), pictures[frame])
    return {"ours": ours.summary(truth.num_seen)}


def _other_view(
    prediction: Prediction, truth: TruthSet, view: str, seen: np.ndarray, anchor: np.ndarray
) -> dict[str, dict[str, Any]]:
    """Of the seen frames. `still mean` is the mean of our own pictures."""
    frames = [frame for frame in truth.frames[view] if frame < truth.num_seen]
    targets = truth.pictures(view)
    ours = [prediction.picture(truth.view(view, frame), frame) for frame in frames]
    still = np.mean(ours, axis=0)
    answers: dict[str, Callable[[int, int], np.ndarray]] = {
        "ours": lambda index, frame: ours[index],
        "still mean": lambda index, frame: still,
    }
    for name in baselines.TRIVIAL:

        def trivial(index: int, frame: int, name: str = name) -> np.ndarray:
            from_view = truth.view(INPUT_VIEW, frame)
            return baselines.trivial_view(name, seen[frame], from_view, truth.view(view, frame), anchor)

        answers[name] = trivial
    return {name: _scored(answer, frames, targets).summary(truth.num_seen) for name, answer in answers.items()}


def _future(prediction: Prediction, truth: TruthSet, view: str, seen: np.ndarray) -> dict[str, dict[str, Any]]:
    """Of the frames after the seen ones. Frozen: the last seen picture, and our picture of the last seen moment."""
    last = truth.num_seen - 1
    wanted = [frame for frame in truth.frames[view] if truth.num_seen <= frame < prediction.num_frames]
    targets = truth.pictures(view)
    first = truth.frames[view].index(wanted[0])
    answers: dict[str, Callable[[int, int], np.ndarray]] = {
        "ours": lambda index, frame: prediction.picture(truth.view(view, frame), frame),
        "frozen reconstruction": lambda index, frame: prediction.picture(truth.view(view, frame), last),
        "frozen picture": lambda index, frame: seen[last],
        "black": lambda index, frame: np.zeros_like(seen[last]),
    }
    found = {name: _scored(answer, wanted, targets[first:]).summary(truth.num_seen) for name, answer in answers.items()}
    for summary in found.values():
        for third in THIRDS:
            summary.pop(f"{third}_db")
    return found


def _scored(answer: Callable[[int, int], np.ndarray], frames: list[int], targets: np.ndarray) -> _Errors:
    errors = _Errors()
    for index, frame in enumerate(frames):
        errors.add(frame, answer(index, frame), targets[index])
    return errors


def _volumes(prediction: Prediction, truth: TruthSet) -> dict[str, Any]:
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
