"""The exported volumes: as dense as the truth says, and as opaque in the clip's own view as the clip.

Particles are finer than voxels. What a grid loses of them is seen at once in the view that they were fitted to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy import ndimage

from backend.contract.result import vdb_path
from backend.contract.truth import INPUT_VIEW
from backend.field.rays import optical_depth
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice
from backend.io.vdb import DenseGrid, read_vdb
from backend.reporting import Report, SilentReport
from backend.score import measures
from backend.score.evaluate import Prediction
from backend.score.tally import mean
from backend.score.truth_set import Pictures, Truth

_MOST_FRAMES = 12  # that are looked at, spread evenly


class Exported:
    """The VDB files of a job, by video frame. Each method raises BackendError where a file or OpenVDB is missing."""

    def __init__(self, folder: Path, *, frame_start: int) -> None:
        self._folder = folder
        self._start = frame_start

    def opacity(self, view: View, frame: int) -> np.ndarray:
        """[H, W]: 1 - exp(-optical depth), voxels interpolated linearly as renderers do."""
        grid = self._density(frame)
        lattice = Lattice(origin=tuple(grid.origin), voxel_size=grid.voxel_size, shape=grid.values.shape)  # type: ignore[arg-type]
        return -np.expm1(-optical_depth(grid.values, lattice, view))

    def density_at(self, lattice: Lattice, frame: int) -> np.ndarray:
        """[X, Y, Z] 1/m at the voxels of another lattice."""
        grid = self._density(frame)
        places = (lattice.centres() - np.asarray(grid.origin)) / grid.voxel_size
        return ndimage.map_coordinates(grid.values, np.moveaxis(places, -1, 0), order=1, mode="grid-constant")

    def _density(self, frame: int) -> DenseGrid:
        return read_vdb(vdb_path(self._folder, frame - self._start), "density")


def opacity_decibels(opacity: np.ndarray, truth: np.ndarray) -> float:
    """PSNR inside true smoke of an opacity [H, W] and that of a true picture [H, W, 4]; NaN where that shows none."""
    mask = measures.smoke_mask(truth)
    return measures.decibels(float(np.square(opacity - truth[..., 3], dtype=np.float64)[mask].mean()) if mask.any() else np.nan)


def opacity_in_clip(
    opacity_at: Callable[[View, int], np.ndarray],  # view, video frame -> [H, W]
    truth: Truth,
    pictures: Pictures,  # of the input view
    frames: Sequence[int],
    *,
    report: Report | None = None,
) -> float | None:
    """Mean of opacity_decibels over frames of the input view; None where none shows smoke."""
    report, places, found = report or SilentReport(), truth.frames[INPUT_VIEW], []
    for step, frame in enumerate(frames):
        report.progress(step, len(frames))
        opacity = opacity_at(truth.view(INPUT_VIEW, frame), frame)
        found.append(opacity_decibels(opacity, np.asarray(pictures[places.index(frame)])))
    report.progress(len(frames), len(frames))
    return mean(found)


def exported_scores(
    exported: Exported, prediction: Prediction, truth: Truth, *, report: Report | None = None
) -> dict[str, float | None]:
    """Of some seen frames the clip's opacity through the exported volumes, and as the particles themselves show it."""
    seen = [frame for frame in truth.frames[INPUT_VIEW] if frame < truth.num_seen]
    frames = [seen[round(index)] for index in np.linspace(0, len(seen) - 1, min(len(seen), _MOST_FRAMES))]
    pictures = truth.pictures(INPUT_VIEW)
    return {
        "opacity_db": opacity_in_clip(exported.opacity, truth, pictures, frames, report=report),
        "particles_opacity_db": opacity_in_clip(
            lambda view, frame: prediction.picture(view, frame)[..., 3], truth, pictures, frames
        ),
    }
