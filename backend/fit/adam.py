"""Adam with a step size in the unit of what it changes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(slots=True)
class Adam:
    """Kingma & Ba 2015, algorithm 1, for one array. Its epsilon is a share of the mean, so that no gradient's scale matters.

    floor: that share. Where it is small, what hardly matters moves as far as what matters; at 1 it moves far less.
    """

    step_size: float | np.ndarray
    first: np.ndarray
    second: np.ndarray
    count: int = 0
    floor: float = 1e-3

    @classmethod
    def like(cls, array: np.ndarray, step_size: float | np.ndarray, *, floor: float = 1e-3) -> Adam:
        return cls(step_size, np.zeros_like(array, np.float64), np.zeros_like(array, np.float64), floor=floor)

    def change(self, gradient: np.ndarray) -> np.ndarray:
        self.count += 1
        self.first = 0.9 * self.first + 0.1 * gradient
        self.second = 0.99 * self.second + 0.01 * gradient * gradient
        mean = self.first / (1.0 - 0.9**self.count)
        spread = np.sqrt(self.second / (1.0 - 0.99**self.count))
        return -self.step_size * mean / (spread + 1e-12 + self.floor * float(spread.mean()))
