"""Where along its rays the smoke of a frame lies: what a volume proposes, else the solid of its silhouette's medial balls."""

from __future__ import annotations

import numpy as np

from backend.fit import depth_prior
from backend.fit.depth_prior import DepthPrior
from backend.fit.guide import Guide
from backend.fit.scene import Scene, optical_depth
from backend.fit.series import Series
from backend.fit.state import VolumeRecord


class Depths:
    """Of the frames of one scene; the newest ones are kept, for a fit asks several times."""

    def __init__(self, scene: Scene, layers: Series[np.ndarray], volumes: Series[VolumeRecord] | None = None) -> None:
        self.scene = scene
        self.layers = layers  # [H, W, 4] premultiplied linear RGB and opacity
        self.volumes = volumes if volumes is not None and len(volumes) else None
        self._prior: tuple[int, DepthPrior] | None = None
        self._guides: dict[int, Guide] = {}

    def prior(self, frame: int) -> DepthPrior:
        """Middle and half thickness of the smoke on each ray of a frame."""
        if self._prior is None or self._prior[0] != frame:
            view = self.scene.views[frame]
            prior = depth_prior.inflate(optical_depth(self.layers[frame]), view, self.scene.anchor)
            guide = self.guide(frame)
            self._prior = frame, prior if guide is None else guide.prior_of(view, prior)
        return self._prior[1]

    def guide(self, frame: int) -> Guide | None:
        """The volume of a frame, if there are volumes."""
        if self.volumes is None:
            return None
        if frame not in self._guides:
            self._guides = {number: guide for number, guide in self._guides.items() if abs(number - frame) <= 1}
            self._guides[frame] = Guide(self.volumes[frame])
        return self._guides[frame]
