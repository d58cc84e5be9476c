"""A source that goes on emitting: what was born at the foot of the smoke is born again, frame after frame."""

from __future__ import annotations

import dataclasses

from backend.fit.population import PER_PARTICLE, AnyRecord, join, take
from backend.fit.series import Series

FOOT = 0.2  # the source is the lowest fifth of the smoke's height
REPLAYED = 24  # frames whose births the source repeats


def births_at_foot(records: Series[AnyRecord]) -> list[AnyRecord]:
    """What was born at the foot of the smoke in each of the last frames of the fit."""
    born = []
    for frame in range(max(1, len(records) - REPLAYED), len(records)):
        record = records[frame]
        if len(record.positions) == 0:
            continue
        height = record.positions[:, 2]
        is_at_foot = height <= height.min() + FOOT * (height.max() - height.min())
        born.append(take(record, is_at_foot & (record.born == frame)))
    return born


def born_again(record: AnyRecord, births: list[AnyRecord], step: int) -> AnyRecord:
    """The record with the newborn of a fitted frame, one frame after the other, over and over."""
    if not births:
        return record
    newborn = births[step % len(births)]
    names = {item.name for item in dataclasses.fields(newborn)} & PER_PARTICLE - {"ids"}
    return join(record, **{name: getattr(newborn, name) for name in names})
