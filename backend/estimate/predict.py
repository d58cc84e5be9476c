"""Seconds, memory and quality of a job, from the survey of its clip, its settings and the speed of this machine."""

from __future__ import annotations

import json
import os
from collections.abc import Collection
from functools import cache
from pathlib import Path
from typing import Any

from backend.contract.estimates import Estimate, Quality
from backend.contract.job import Config
from backend.estimate.machine import Machine, this_machine
from backend.estimate.work import asks_prior, kinds_of, memory_terms, pixels_of, terms_of
from backend.fit.survey import Survey

FOLDER = Path(__file__).resolve().parent
COSTS_FILE = FOLDER / "costs.json"
QUALITY_FILE = FOLDER / "quality.json"
COMPILE_SECONDS = 60.0  # of all kernels together, where this version has not run yet
QUALITY_SECTIONS = ("method", "frames", "volume", "physical", "visual", "published")  # settings that the figures depend on


def estimate(
    seen: Survey,
    config: Config,
    *,
    preset: str,
    chosen: Collection[str] = (),  # keys of the settings that the user set
    machine: Machine | None = None,
) -> Estimate:
    """config: with what was decided in place. Without a machine this one is asked, which may take some seconds once."""
    needs_compiling = not Path(os.environ["NUMBA_CACHE_DIR"]).is_dir()
    machine = machine or this_machine(kinds_of(config))
    stages = stage_seconds(seen, config, machine=machine)
    is_measured = not any(key.partition(".")[0] in QUALITY_SECTIONS for key in chosen)
    return Estimate(
        preset=preset,
        seconds=round(sum(stages.values()), 1),
        stages={name: round(seconds, 2) for name, seconds in stages.items()},
        memory_gib=round(memory_gib(seen, config), 2),
        compile_seconds=COMPILE_SECONDS if needs_compiling else 0.0,
        quality=quality_of(preset, is_seen_around=asks_prior(config)) if is_measured else (),
    )


def stage_seconds(seen: Survey, config: Config, *, machine: Machine) -> dict[str, float]:
    """Of each stage in order, the survey itself as "inspect"; "start" is what passes before it."""
    coefficients = costs()["stages"]
    found = {"start": 0.0, "inspect": seen.pace.whole}
    for stage, terms in terms_of(seen, config, threads=machine.threads).items():
        known = coefficients.get(stage, {})
        found[stage] = sum(known.get(term.name, 0.0) * term.amount * machine.seconds[term.kind] for term in terms)
    larger = pixels_of(seen, config) / (seen.size[0] * seen.size[1])
    found["frames"] += seen.num_frames * (seen.pace.decode + seen.pace.reduce)
    found["smoke"] += larger * (seen.pace.prepare + seen.num_frames * seen.pace.extract)
    return found


def memory_gib(seen: Survey, config: Config) -> float:
    """Peak of the backend's process."""
    known = costs()["memory_gib"]
    return sum(known.get(name, 0.0) * amount for name, amount in memory_terms(seen, config).items())


def quality_of(preset: str, *, is_seen_around: bool) -> tuple[Quality, ...]:
    """The benchmark's figures for a preset; from the side only where the camera goes around the smoke, as it does there."""
    known = json.loads(QUALITY_FILE.read_text(encoding="utf-8"))["presets"].get(preset, {})
    views = ("input", "side") if is_seen_around else ("input",)
    return tuple(Quality(view=view, **known[view]) for view in views if view in known)


@cache
def costs() -> dict[str, Any]:
    """costs.json: the coefficient of every term, and on what they were measured."""
    return json.loads(COSTS_FILE.read_text(encoding="utf-8"))
