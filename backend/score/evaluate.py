"""A reconstruction against the truth: views it never saw, frames it never saw, the volume, the velocity; beside it what
trivial answers get on the same pictures, and the volumes that the particles followed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import numpy as np

from backend.contract.truth import INPUT_VIEW
from backend.geometry.camera import View
from backend.reporting import Report, SilentReport
from backend.score import baselines
from backend.score.compare import OURS
from backend.score.measures import Target, coded
from backend.score.perceptual import Perceptual
from backend.score.tally import Tally
from backend.score.temporal import FlowError
from backend.score.truth_set import Pictures, Truth
from backend.score.volumes import Volumes, volume_scores


class Prediction(Volumes, Protocol):
    """What is scored. Frames are video frames; those from num_seen on are a forecast."""

    num_frames: int

    def picture(self, view: View, frame: int) -> np.ndarray:
        """[H, W, 4] linear premultiplied light and opacity."""
        ...


Answer = Callable[[int], np.ndarray]  # video frame -> [H, W, 4]
Reports = Callable[[str], Report]  # begins a part of the work and says where to report it


@dataclass(frozen=True, slots=True, kw_only=True)
class Round:
    """Answers that are compared on the same frames of a view. num_seen: of which thirds are made; 0 for none."""

    name: str
    view: str
    frames: list[int]
    answers: dict[str, Answer]
    num_seen: int


def evaluate(
    prediction: Prediction,
    truth: Truth,
    *,
    anchor: np.ndarray,  # [3] m: where billboards stand
    prior: Volumes | None = None,
    perceptual: Perceptual | None = None,
    begin: Reports = lambda name: SilentReport(),
) -> dict[str, Any]:
    """All scores of one reconstruction. Nothing is rounded before it is averaged."""
    seen = truth.pictures(INPUT_VIEW)
    scores: dict[str, Any] = {"scene": truth.name}
    future: dict[str, Any] = {}
    motion: dict[str, Any] = {}
    places = {view: {frame: index for index, frame in enumerate(frames)} for view, frames in truth.frames.items()}
    for view in truth.frames:
        pictures = seen if view == INPUT_VIEW else truth.pictures(view)
        for part in rounds_of(prediction, truth, view, seen, anchor):
            report = begin(f"view {part.name}".replace("_", " "))
            found, motion[part.name] = _scored(part, pictures, places[view], perceptual, report)
            (scores if part.num_seen else future)[part.name] = found
    scores |= future
    scores["motion"] = motion
    scores["by_frame_angle"] = angles(truth, anchor)
    scores["volume"] = volume_scores(prediction, truth, report=begin("volumes"))
    if prior is not None:
        scores["prior_volume"] = volume_scores(prior, truth, report=begin("prior"))
    return scores


def _scored(
    part: Round,
    pictures: Pictures,
    places: Mapping[int, int],  # frame -> its picture
    perceptual: Perceptual | None,
    report: Report,
) -> tuple[dict[str, Any], dict[str, float]]:
    """Figures of every answer, and of ours the error of its optical flow."""
    tallies = {name: Tally(part.frames, perceptual=perceptual) for name in part.answers}
    flow = FlowError(len(part.frames))
    for step, frame in enumerate(part.frames):
        report.progress(step, len(part.frames))
        target = Target(pictures[places[frame]])
        for name, answer in part.answers.items():
            tallies[name].add(frame, answer(frame), target)
        flow.add(coded(part.answers[OURS](frame)), target)
    report.progress(len(part.frames), len(part.frames))
    return {name: tally.summary(part.num_seen) for name, tally in tallies.items()}, flow.summary()


def rounds_of(prediction: Prediction, truth: Truth, view: str, seen: Pictures, anchor: np.ndarray) -> list[Round]:
    """What is compared in a view: its seen frames, and those ahead where the forecast reaches them. Nothing is drawn yet."""
    asked = [frame for frame in truth.frames[view] if frame < prediction.num_frames]
    past = [frame for frame in asked if frame < truth.num_seen]
    ahead = [frame for frame in asked if frame >= truth.num_seen]

    @cache
    def shown(frame: int) -> np.ndarray:
        return prediction.picture(truth.view(view, frame), frame)

    @cache
    def still() -> np.ndarray:
        return np.mean([shown(frame) for frame in past], axis=0)

    ours: dict[str, Answer] = {OURS: shown, "still mean": lambda frame: still()}
    answers = ours | _trivial(truth, view, seen, anchor)
    if view == INPUT_VIEW:  # where a copy is the truth itself
        answers = {name: answers[name] for name in (OURS, "black", "grey")}
    rounds = [Round(name=view, view=view, frames=past, answers=answers, num_seen=truth.num_seen)]
    if ahead and view in truth.future_views:
        answers = ours | _frozen(prediction, truth, view, seen, anchor)
        rounds.append(Round(name=f"future_{view}", view=view, frames=ahead, answers=answers, num_seen=0))
    return rounds


def angles(truth: Truth, anchor: np.ndarray) -> dict[str, dict[str, float]]:
    """Of every view but the input's, by frame: degrees between it and the input camera, seen from the anchor [3] m."""

    def towards(view: str, frame: int) -> np.ndarray:
        away = truth.view(view, frame).position - anchor
        return away / max(float(np.linalg.norm(away)), 1e-12)

    def degrees(view: str, frame: int) -> float:
        cosine = float(np.clip(towards(view, frame) @ towards(INPUT_VIEW, frame), -1.0, 1.0))
        return round(float(np.degrees(np.arccos(cosine))), 2)

    others = {view: frames for view, frames in truth.frames.items() if view != INPUT_VIEW}
    return {view: {str(frame): degrees(view, frame) for frame in frames} for view, frames in others.items()}


def _trivial(truth: Truth, view: str, seen: Pictures, anchor: np.ndarray) -> dict[str, Answer]:
    """What needs no reconstruction, from the input picture of the same moment."""

    def answer(frame: int, name: str) -> np.ndarray:
        return baselines.trivial_view(name, seen[frame], truth.view(INPUT_VIEW, frame), truth.view(view, frame), anchor)

    return {name: lambda frame, name=name: answer(frame, name) for name in baselines.TRIVIAL}


def _frozen(prediction: Prediction, truth: Truth, view: str, seen: Pictures, anchor: np.ndarray) -> dict[str, Answer]:
    """What needs no forecast: our last seen moment held still, and trivial answers from the last seen picture."""
    last = truth.num_seen - 1

    def answer(frame: int, name: str) -> np.ndarray:
        return baselines.trivial_view(name, seen[last], truth.view(INPUT_VIEW, last), truth.view(view, frame), anchor)

    names = {name: name if name in ("black", "grey") else f"frozen {name}" for name in baselines.TRIVIAL}
    return {"frozen reconstruction": lambda frame: prediction.picture(truth.view(view, frame), last)} | {
        title: lambda frame, name=name: answer(frame, name) for name, title in names.items()
    }
