"""The figures of one answer in one view, gathered frame by frame.

Means of decibels are over frames, each at most 50 dB; `global_db` is that of the mean squared error of all of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from backend.score import measures
from backend.score.measures import Target
from backend.score.perceptual import Perceptual
from backend.score.similarity import similarity
from backend.score.temporal import Changes

THIRDS = ("first", "middle", "last")
_MOST_PERCEPTUAL = 8  # frames of an answer that a network is asked about, spread evenly: it costs more than all else


class Tally:
    """frames: those that will be added, in order. perceptual: a network, where its weights are known."""

    def __init__(self, frames: list[int], *, perceptual: Perceptual | None = None) -> None:
        self._frames = frames
        self._perceptual = perceptual
        spread = np.linspace(0, len(frames) - 1, min(len(frames), _MOST_PERCEPTUAL))
        self._asked = {frames[round(index)] for index in spread} if perceptual is not None else set()
        self._rows: dict[str, list[float]] = {"full": [], "smoke": [], "ssim": [], "smoke_ssim": []}
        self._distances: list[float] = []
        self._changes = Changes()

    def add(self, frame: int, picture: np.ndarray, target: Target) -> None:
        """The answer [H, W, 4] at a frame. Raises ValueError where its size is not the truth's."""
        if picture.shape != target.picture.shape:
            raise ValueError(f"a picture {picture.shape} of a truth {target.picture.shape}")
        shown = measures.coded(picture)
        figures = *measures.coded_errors(shown, target), *similarity(shown, target.moments, target.smoke)
        for row, value in zip(self._rows.values(), figures, strict=True):
            row.append(value)
        self._changes.add(shown, target)
        if self._perceptual is not None and frame in self._asked:
            self._distances.append(self._perceptual.distance(shown, target.coded))

    def summary(self, num_seen: int) -> dict[str, Any]:
        """Means over all frames, and over each third of num_seen frames; 0: they are none of these."""
        full = [measures.decibels(error) for error in self._rows["full"]]
        smoke = [measures.decibels(error) for error in self._rows["smoke"] if not np.isnan(error)]
        global_db = measures.decibels(float(np.mean(self._rows["full"])))
        found: dict[str, Any] = {"full_db": mean(full), "global_db": rounded(global_db), "smoke_db": mean(smoke)}
        for third, name in enumerate(THIRDS if num_seen else ()):
            part = [value for frame, value in zip(self._frames, full, strict=True) if 3 * frame // num_seen == third]
            found[f"{name}_db"] = mean(part)
        found |= {name: mean(self._rows[name]) for name in ("ssim", "smoke_ssim")}
        if self._perceptual is not None:
            found[self._perceptual.name] = mean(self._distances)
        found |= {"dtssd": mean([self._changes.dtssd], digits=5), "change_ratio": mean([self._changes.ratio])}
        found["by_frame_db"] = self._by_frame(full)
        found["by_frame_ssim"] = self._by_frame(self._rows["ssim"])
        return found

    def _by_frame(self, values: list[float]) -> dict[str, float]:
        return {str(frame): rounded(value) for frame, value in zip(self._frames, values, strict=True)}


def mean(values: list[float], *, digits: int = 4) -> float | None:
    """Of what is no NaN; None without any."""
    found = [value for value in values if not np.isnan(value)]
    return round(float(np.mean(found)), digits) if found else None


def rounded(value: float) -> float:
    return round(value, 4)
