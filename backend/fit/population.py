"""Which particles there are: how much smoke a frame shows, who is near the image, who stays."""

from __future__ import annotations

import dataclasses
from typing import TypeVar

import numpy as np

from backend.fit.depth_prior import plane_depth
from backend.fit.scene import Scene, optical_depth
from backend.fit.state import PhysicalRecord, VisualRecord
from backend.geometry.camera import View

MARGIN = 0.4  # share of the image around it in which particles live on unseen
PER_PARTICLE = {"positions", "velocities", "masses", "optical_masses", "scales", "rotations", "colors", "ids", "born"}

AnyRecord = TypeVar("AnyRecord", PhysicalRecord, VisualRecord)


def pixel_mass(view: View, depth: np.ndarray) -> np.ndarray:
    """Optical mass m^2 of one pixel of optical depth one at `depth` m: the area that the pixel covers there."""
    return depth * depth / (view.fx * view.fy)


def frame_mass(scene: Scene, layer: np.ndarray, frame: int) -> float:
    """Optical mass m^2 that a frame shows, with all smoke at the prior's central depth."""
    view = scene.views[frame]
    area = pixel_mass(view, plane_depth(view, scene.anchor))
    return float((optical_depth(layer) * area).sum(dtype=np.float64))


def is_near_image(positions: np.ndarray, view: View) -> np.ndarray:
    """[N] bool: inside the image or its margin, and in front of the camera."""
    pixels, depth = view.project(positions)
    x, y = pixels[:, 0] / view.width, pixels[:, 1] / view.height
    return (depth > 0) & (x > -MARGIN) & (x < 1 + MARGIN) & (y > -MARGIN) & (y < 1 + MARGIN)


def is_in_image(positions: np.ndarray, view: View) -> np.ndarray:
    """[N] bool: the image shows the middle of the particle."""
    pixels, depth = view.project(positions)
    x, y = pixels[:, 0] / view.width, pixels[:, 1] / view.height
    return (depth > 0) & (x >= 0) & (x <= 1) & (y >= 0) & (y <= 1)


def not_grown_beside(fitted: np.ndarray, before: np.ndarray, positions: np.ndarray, view: View) -> np.ndarray:
    """Masses [N] after a fit, where only the edge of a particle is in the image at most what they were: a tail that is seen
    says next to nothing of the whole, and to explain a pixel with it the whole would have to become huge."""
    return np.where(is_in_image(positions, view), fitted, np.minimum(fitted, before))


def take(record: AnyRecord, is_kept: np.ndarray) -> AnyRecord:
    """The record with some of its particles."""
    return dataclasses.replace(record, **{name: getattr(record, name)[is_kept] for name in _names(record)})


def join(record: AnyRecord, **newborn: np.ndarray) -> AnyRecord:
    """The record with newborn particles behind its own; ids and next_id are given here."""
    count = len(newborn["positions"])
    newborn["ids"] = record.next_id + np.arange(count, dtype=np.int64)
    joined = {}
    for name in _names(record):
        old = getattr(record, name)
        joined[name] = np.concatenate([old, np.asarray(newborn[name]).astype(old.dtype)])
    return dataclasses.replace(record, **joined, next_id=np.asarray(record.next_id + count, np.int64))


def _names(record: AnyRecord) -> set[str]:
    """The arrays of a record that hold a row for each particle."""
    names = {item.name for item in dataclasses.fields(record)} & PER_PARTICLE
    return {name for name in names if getattr(record, name) is not None}
