"""The future as the published methods foretell it: the fluid goes on by itself, the source repeats itself, looks stay."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from backend.contract.job import PublishedConfig
from backend.fit.carry import as_fluid, carry, with_velocities
from backend.fit.population import AnyRecord, is_near_image, take
from backend.fit.replay import births_at_foot, born_again
from backend.fit.series import Series
from backend.fit.state import PhysicalRecord, VisualRecord
from backend.geometry.camera import View
from backend.physics import fluid as fluids
from backend.published.physical import fluid_of
from backend.reporting import Report


def run(
    fluid: Series[PhysicalRecord],
    seen: Series[VisualRecord],
    config: PublishedConfig,
    report: Report,
    *,
    num_frames: int,
    view: View,  # of the last frame; what leaves it far behind is dropped
    seconds: float,  # of a frame
) -> Iterator[VisualRecord]:
    """Yields `num_frames` records behind the last frame."""
    record, look = fluid[len(fluid) - 1], seen[len(seen) - 1]
    sources = (births_at_foot(fluid), births_at_foot(seen))
    for step in range(num_frames):
        report.progress(step, num_frames)
        if len(record.positions):
            state, _ = fluids.step(as_fluid(record), fluid_of(record, config), seconds)
            record = replace(record, positions=state.positions, velocities=state.velocities)
        look = carry(look, record, seconds=seconds)
        record = _near(born_again(record, sources[0], step), view)
        look = _near(born_again(look, sources[1], step), view)
        look = with_velocities(look, record)
        yield look
    report.progress(num_frames, num_frames)


def _near(record: AnyRecord, view: View) -> AnyRecord:
    return take(record, is_near_image(record.positions, view))
