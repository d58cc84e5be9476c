"""How pictures change from one to the next, against how the truth does. A still picture flickers in neither.

dtSSD: Erofeev, Gitman, Vatolin, Fedorov, Wang 2015 ("Perceptually motivated benchmark for video matting"): the root of the
mean squared difference between the changes, here of coded light instead of opacity; mean over pairs of neighbours.
tOF: Chu, Xie, Mayer, Leal-Taixe, Thuerey 2020 ("Learning temporal coherence via self-supervision for GAN-based video
generation"): mean difference of the optical flows, sum of both axes, with Farneback's flow as there.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from backend.io.images import LUMINANCE
from backend.score.measures import Target

_MOST_FLOWS = 32


@dataclass
class Changes:
    """Between neighbours of one answer, in the order in which they are added."""

    errors: list[float] = field(default_factory=list)  # root mean squares
    ours: float = 0.0  # sums of mean squares
    real: float = 0.0
    _before: tuple[np.ndarray, np.ndarray] | None = None

    def add(self, shown: np.ndarray, target: Target) -> None:
        """The next picture [H, W, 3], coded, and its truth."""
        if self._before is not None:
            ours, real = shown - self._before[0], target.coded - self._before[1]
            self.errors.append(float(np.sqrt(np.mean(np.square(ours - real), dtype=np.float64))))
            self.ours += float(np.mean(np.square(ours), dtype=np.float64))
            self.real += float(np.mean(np.square(real), dtype=np.float64))
        self._before = shown, target.coded

    @property
    def dtssd(self) -> float:
        """NaN of fewer than two pictures."""
        return float(np.mean(self.errors)) if self.errors else float("nan")

    @property
    def ratio(self) -> float:
        """Root mean square of our changes over that of the true ones: above 1 it flickers, below it is too still."""
        return float(np.sqrt(self.ours / self.real)) if self.real > 0.0 else float("nan")


@dataclass
class FlowError:
    """tOF of one answer inside the true smoke, px from one picture to the next. num_pictures: that will be added; of their
    pairs of neighbours about _MOST_FLOWS are looked at, spread evenly."""

    num_pictures: int
    errors: list[float] = field(default_factory=list)
    still: list[float] = field(default_factory=list)  # of an answer that never moves: how far the truth moves
    _before: tuple[np.ndarray, np.ndarray] | None = None
    _added: int = 0

    def add(self, shown: np.ndarray, target: Target) -> None:
        """The next picture [H, W, 3], coded, and its truth."""
        self._added += 1
        is_asked = self._added % max(1, self.num_pictures // _MOST_FLOWS) == 0
        if is_asked and self._before is not None and target.smoke.any():
            real = _flow(self._before[1], target.coded)[target.smoke]
            ours = _flow(self._before[0], shown)[target.smoke]
            self.errors.append(float(np.abs(ours - real).sum(axis=1).mean()))
            self.still.append(float(np.abs(real).sum(axis=1).mean()))
        self._before = shown, target.coded

    def summary(self) -> dict[str, float]:
        """Means over pairs of neighbours; empty where no pair shows smoke."""
        if not self.errors:
            return {}
        return {"tof": round(float(np.mean(self.errors)), 4), "still": round(float(np.mean(self.still)), 4)}


def _flow(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """[H, W, 2] px, of coded light."""
    first, second = ((255.0 * np.clip(picture @ LUMINANCE, 0.0, 1.0)).astype(np.uint8) for picture in (before, after))
    start = np.zeros((*first.shape, 2), np.float32)
    return cv2.calcOpticalFlowFarneback(first, second, start, 0.5, 3, 15, 3, 5, 1.2, 0)
