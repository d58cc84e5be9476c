"""What the last frames of a fit tell of the next ones: how each parcel goes on, how far to trust it.

Smoke goes on as it went: a parcel keeps the velocity that it had. Over the seconds that a forecast is good for that was
better than a fluid under pressure and buoyancy, for what those do to a field that is known only roughly is rougher still.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from backend.contract.job import ForecastConfig
from backend.fit.carry import as_fluid
from backend.fit.guide import Guide
from backend.fit.ray_motion import followed
from backend.fit.scene import Scene, optical_depth
from backend.fit.series import Series
from backend.fit.state import PhysicalRecord, VisualRecord, VolumeRecord
from backend.physics.interpolate import interpolate_velocity

RECENT = 4  # frames whose velocities are averaged: one alone holds the correction of its own picture
DOUBT = 0.8  # of a parcel's way: measured with true velocities on the tuning scenes, 0.5 to 1.1 in each


@dataclass(frozen=True, slots=True, kw_only=True)
class Trust:
    """How far a forecast may be trusted. speed: m/s, root mean square; rate: 1/s, at which trust in the motion is lost;
    confirmed: how much of it the last frames bear out, 0 to 1."""

    speed: float
    rate: float
    spreading: float  # standard deviation of a parcel's way, share of it
    confirmed: float = 1.0

    def share_moved(self, seconds: float) -> float:
        """Of the smoke; the rest stays where it was seen last."""
        return self.confirmed * math.exp(-self.rate * seconds)

    def growth(self, seconds: float) -> float:
        """m: standard deviation of where moved smoke is."""
        return self.spreading * self.speed * seconds

    def deviation(self, seconds: float) -> float:
        """m: root mean square distance between where a parcel is foretold and where it will be."""
        return DOUBT * self.speed * seconds


def trust_of(record: VisualRecord, config: ForecastConfig) -> Trust:
    """From the last frame alone. Trust is lost with the ways that smoke goes, in units of its own size."""
    masses = record.optical_masses.astype(np.float64)
    total = float(masses.sum())
    if not total > 0.0:
        return Trust(speed=0.0, rate=0.0, spreading=config.spreading)
    squares = np.square(record.velocities, dtype=np.float64).sum(axis=1)
    speed = math.sqrt(float(masses @ squares) / total)
    offsets = record.positions - masses @ record.positions / total
    spreads = np.sqrt(masses @ np.square(offsets) / total)  # [3] m
    size = float(np.cbrt(np.prod(spreads)))
    return Trust(speed=speed, rate=config.fading * speed / size if size > 0.0 else 0.0, spreading=config.spreading)


def recent_guides(volumes: Series[VolumeRecord], layers: Series[np.ndarray], scene: Scene) -> list[Guide]:
    """The last frames' volumes, with the motion that the pictures show of each ray; layers: [H, W, 4] of all frames."""
    guides = []
    for frame in range(max(0, len(layers) - RECENT), len(layers)):
        beside = range(max(0, frame - 1), min(len(layers), frame + 2))
        depths, views = [optical_depth(layers[number]) for number in beside], [scene.views[number] for number in beside]
        seconds = scene.seconds_per_frame
        velocity = followed(Guide(volumes[frame]), depths, views, beside.index(frame), seconds=seconds)
        guides.append(Guide(replace(volumes[frame], velocity=velocity, velocity_unit=np.asarray(1.0))))
    return guides


def recent_velocity(
    points: np.ndarray,  # [N, 3] m
    fluid: Series[PhysicalRecord],
    guides: Sequence[Guide],  # the last frames' volumes, if there are any
) -> np.ndarray:  # [N, 3] m/s
    """Mean of the last frames' velocities there: of the physical particles and, where there are volumes, of those too.

    The particles' are sharper and drawn to what the pictures show, the volumes' know depth; their errors differ.
    """
    found = [guide.velocity_at(points) for guide in guides]
    for back in range(1, min(RECENT, len(fluid)) + 1):
        record = fluid[len(fluid) - back]
        found.append(interpolate_velocity(points, as_fluid(record), float(record.smoothing_length))[0])
    return np.mean(found, axis=0)
