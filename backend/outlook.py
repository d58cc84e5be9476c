"""What there is to know of a job before it starts: the decisions for its clip, and what each preset would cost."""

from __future__ import annotations

from backend.contract.cameras import read_cameras
from backend.contract.estimates import Outlook
from backend.contract.job import PRESETS, Job, override, preset_config
from backend.estimate.machine import Machine, this_machine
from backend.estimate.predict import estimate
from backend.estimate.work import kinds_of
from backend.io.video import open_clip
from backend.reporting import Report
from backend.stages import frames, inspect


def outlook_of(job: Job, report: Report, *, machine: Machine | None = None) -> Outlook:
    """One survey of the clip serves all presets. Raises BackendError, as a run would."""
    given = None if job.cameras is None else read_cameras(job.cameras)
    configs = {name: override(preset_config(name), job.overrides) for name in dict.fromkeys((job.preset, *PRESETS))}
    asked = configs[job.preset]
    with open_clip(job.video, frame_rate=asked.frames.frame_rate) as clip:
        start, stop = frames.frame_range(clip, job.frame_start, job.frame_stop)
        decisions, seen = inspect.run(clip, asked, report, chosen=job.overrides, start=start, stop=stop, given=given)
    followed = {name: inspect.decide(seen, config, chosen=job.overrides).followed(config) for name, config in configs.items()}
    machine = machine or this_machine({kind: None for config in followed.values() for kind in kinds_of(config)})
    estimates = tuple(estimate(seen, followed[name], preset=name, chosen=job.overrides, machine=machine) for name in PRESETS)
    return Outlook(decisions=decisions, estimates=estimates)
