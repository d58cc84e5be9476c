"""What a job will cost and how good it may become, as it is told before Start. `inspect --json` prints one for each preset;
the job folder keeps its own in estimate.json."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .decisions import Decisions, decisions_of

ESTIMATE_FILE = "estimate.json"
ESTIMATE_FORMAT_VERSION = 1
FACTOR = 1.5  # the time is within this factor, up and down, on a machine that has nothing else to do


@dataclass(frozen=True, slots=True, kw_only=True)
class Quality:
    """What the benchmark's scenes reached with a preset. view: "input" or "side". mean_db, spread_db: PSNR on the smoke
    (input) or over the frame (side), mean and standard deviation over num_scenes scenes."""

    view: str
    mean_db: float
    spread_db: float
    num_scenes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Of one preset. seconds: of all stages; stages: of each, in order. memory_gib: the largest of the backend's process.

    compile_seconds: besides, where this version runs for the first time. quality: empty where the benchmark has no figures
    for these settings. fingerprint: of the job that it was made for.
    """

    preset: str
    seconds: float
    stages: dict[str, float]
    memory_gib: float
    compile_seconds: float = 0.0
    quality: tuple[Quality, ...] = ()
    fingerprint: str = ""

    def to_json(self) -> str:
        return json.dumps({"format_version": ESTIMATE_FORMAT_VERSION, **dataclasses.asdict(self)}, indent=2, allow_nan=False)

    def to_text(self) -> str:
        """One line for people."""
        words = f"{spoken(self.seconds / FACTOR, self.seconds * FACTOR)}, {self.memory_gib:.1f} GiB"
        if self.compile_seconds:
            words += f", and once {spoken(self.compile_seconds, self.compile_seconds)} for this version's first run"
        return f"{self.preset}: {words}; {quality_text(self.quality)}"


def quality_text(quality: tuple[Quality, ...]) -> str:
    """What may be hoped for, in words."""
    if not quality:
        return "quality: not measured with these settings"
    names = {"input": "in the clip's own view", "side": "from the side"}
    parts = [f"{item.mean_db:.0f} ± {max(item.spread_db, 0.5):.0f} dB {names.get(item.view, item.view)}" for item in quality]
    return f"{', '.join(parts)} on {quality[0].num_scenes} test scenes"


def spoken(low: float, high: float) -> str:
    """A span of seconds as a person says it: "40 to 90 s", "2 to 4 min"."""
    if round(low) == round(high) or high < 1.0:
        return f"{max(1, round(high))} s" if high <= 90.0 else f"{high / 60.0:.0f} min"
    if high <= 90.0:
        return f"{max(1, round(low))} to {round(high)} s"
    if high < 5400.0:
        return f"{_minutes(low)} to {_minutes(high)} min"
    return f"{low / 3600.0:.1f} to {high / 3600.0:.1f} h"


def _minutes(seconds: float) -> str:
    minutes = seconds / 60.0
    return f"{minutes:.1f}" if minutes < 3.0 else f"{minutes:.0f}"


def read_estimate(text: str) -> Estimate:
    """From what to_json() wrote. Raises ValueError, TypeError, KeyError or AttributeError where it is anything else."""
    data = json.loads(text)
    if data.pop("format_version") != ESTIMATE_FORMAT_VERSION:
        raise ValueError("another format version")
    return estimate_of(data)


def kept_estimate(job_folder: str | os.PathLike[str], *, fingerprint: str) -> Estimate | None:
    """What a job was estimated to take; None where its file is another's or cannot be read: then its pace alone tells."""
    try:
        found = read_estimate((Path(job_folder) / ESTIMATE_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    return found if found.fingerprint == fingerprint else None


def estimate_of(data: Mapping[str, Any]) -> Estimate:
    """From the object of one estimate."""
    quality = tuple(Quality(**entry) for entry in data["quality"])
    found = Estimate(**{**data, "quality": quality, "stages": dict(data["stages"])})
    numbers = [found.seconds, found.memory_gib, found.compile_seconds, *found.stages.values()]
    numbers += [number for item in quality for number in (item.mean_db, item.spread_db, item.num_scenes)]
    if not all(_is_number(number) for number in numbers) or min(numbers[: 3 + len(found.stages)]) < 0:
        raise ValueError("a figure is no number")
    if not all(isinstance(word, str) for word in (found.preset, found.fingerprint, *(item.view for item in quality))):
        raise ValueError("a name is no text")
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outlook:
    """All that `inspect` tells: what was decided for the preset that was asked for, and an estimate for each preset."""

    decisions: Decisions
    estimates: tuple[Estimate, ...]

    def to_json(self) -> str:
        estimates = [json.loads(item.to_json()) for item in self.estimates]
        return json.dumps({**json.loads(self.decisions.to_json()), "estimates": estimates}, indent=2, allow_nan=False)

    def to_text(self) -> str:
        warnings = [f"warning: {entry.message}" for entry in self.decisions.warnings]
        return "\n".join([self.decisions.to_text(), *warnings, "", *(item.to_text() for item in self.estimates)])


def read_outlook(text: str) -> Outlook:
    """From what to_json() wrote. Raises ValueError, TypeError, KeyError or AttributeError where it is anything else."""
    data = json.loads(text)
    estimates = data.pop("estimates")
    return Outlook(decisions=decisions_of(data), estimates=tuple(read_estimate(json.dumps(item)) for item in estimates))
