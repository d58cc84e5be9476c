"""All scores of a finished job."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from backend.contract.cameras import Cameras, read_cameras
from backend.contract.errors import BackendError
from backend.contract.result import read_result
from backend.contract.truth import INPUT_VIEW
from backend.fit.scene import make_scene
from backend.fit.state import VolumeRecord
from backend.geometry.camera import view_at
from backend.io.frame_stack import FrameStack
from backend.io.job_folder import JobFolder
from backend.io.particles import Particles, read_particles
from backend.io.records import RecordFile, open_stage_file
from backend.reporting import SilentReport
from backend.score.evaluate import Reports, evaluate
from backend.score.exported import Exported, exported_scores
from backend.score.particles import ParticlePrediction, learned_buoyancy, learned_light, mean_divergence
from backend.score.perceptual import Perceptual
from backend.score.proposals import Proposals
from backend.score.truth_set import Truth

_SAME_PLACE = 0.01  # of the distance to the smoke: further apart, cameras are not of one world
_SAME_ANGLE = 0.02  # of a unit axis, and of the field of view


@dataclass(frozen=True, slots=True, kw_only=True)
class FinishedJob:
    """A job that can be scored. anchor: [3] m, where billboards stand."""

    folder: JobFolder
    particles: Particles
    prediction: ParticlePrediction
    proposals: Proposals | None
    anchor: np.ndarray


@contextmanager
def open_job(folder: JobFolder, truth: Truth) -> Iterator[FinishedJob]:
    """Raises BackendError, also where the job is not finished, was solved in another world than the truth's, or is of fewer
    frames than the scene shows: a mean over easier frames is no figure."""
    read_result(folder.path)
    with ExitStack() as stack:
        layers = FrameStack(stack.enter_context(open_stage_file(folder.smoke)), "smoke")
        cameras = read_cameras(folder.cameras)
        anchor = make_scene(layers, cameras).anchor
        particles = stack.enter_context(read_particles(folder.particles))
        if particles.info.frame_start or particles.num_frames != truth.num_seen:
            raise BackendError(
                "job_of_other_frames",
                f"The job holds {particles.num_frames} frames from {particles.info.frame_start} on, the scene {truth.name} "
                f"shows {truth.num_seen}.",
                hint="Fit all frames of the scene's input.",
            )
        check_world(cameras, truth, anchor)
        proposals = None
        if "prior_fingerprint" in particles.info.provenance:  # else a volume.h5 is another job's
            records = stack.enter_context(RecordFile(folder.volume, VolumeRecord))
            proposals = Proposals(records, frame_start=particles.info.frame_start)
        yield FinishedJob(
            folder=folder,
            particles=particles,
            prediction=ParticlePrediction(particles),
            proposals=proposals,
            anchor=anchor,
        )


def score_job(
    folder: JobFolder,
    truth: Truth,
    *,
    perceptual: Perceptual | None = None,
    begin: Reports = lambda name: SilentReport(),
) -> dict[str, Any]:
    """What `evaluate` finds, and of the particles their divergence and buoyancy. Raises BackendError as open_job does."""
    with open_job(folder, truth) as job:
        return scores_of(job, truth, perceptual=perceptual, begin=begin)


def scores_of(job: FinishedJob, truth: Truth, *, perceptual: Perceptual | None, begin: Reports) -> dict[str, Any]:
    """job: how it was made. not_measured: what is left out, and why."""
    scores = evaluate(job.prediction, truth, anchor=job.anchor, prior=job.proposals, perceptual=perceptual, begin=begin)
    scores["divergence"] = mean_divergence(job.particles, report=begin("divergence"))
    scores["buoyancy"] = learned_buoyancy(job.particles)
    scores["light"] = learned_light(job.particles)
    missing = {}
    exported = Exported(job.folder.vdb, frame_start=job.particles.info.frame_start)
    try:
        scores["exported"] = exported_scores(exported, job.prediction, truth, report=begin("exported"))
    except BackendError as error:
        missing["exported"] = error.message
    if perceptual is None:
        missing["lpips"] = "no weights; --lpips FILE reads them"
    if not scores["volume"]:
        missing["volume"] = "the truth holds no volumes"
    elif "velocity" not in scores["volume"]:
        missing["velocity"] = "the truth holds no velocities"
    if not any(name.startswith("future_") for name in scores):
        missing["future"] = "the job holds no forecast of frames that the truth shows"
    return scores | {"job": job_facts(job), "not_measured": missing}


def job_facts(job: FinishedJob) -> dict[str, Any]:
    """Program, preset and method; no times, so that equal jobs have equal scores."""
    provenance = job.particles.info.provenance
    settings = provenance.get("settings", {})
    return {"program": provenance.get("program"), "preset": provenance.get("preset"), "method": settings.get("method")}


def stage_seconds(job: FinishedJob) -> dict[str, float]:
    """Wall-clock seconds of every stage of the job's last run, as far as it kept them: a note for people."""
    try:
        seconds = json.loads(job.folder.timing.read_text(encoding="utf-8"))
        return {str(stage): float(value) for stage, value in seconds.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def check_world(cameras: Cameras, truth: Truth, anchor: np.ndarray) -> None:
    """Raises BackendError where the job's cameras are not those that the truth's input was filmed with."""
    for frame in (0, truth.num_seen // 2, truth.num_seen - 1):
        ours, real = view_at(cameras, frame), truth.view(INPUT_VIEW, frame)
        distance = max(float(np.linalg.norm(real.position - anchor)), 1e-12)
        is_near = np.linalg.norm(ours.position - real.position) <= _SAME_PLACE * distance
        turn = np.abs(ours.camera_to_world[:3, :3] - real.camera_to_world[:3, :3]).max()
        widths = ours.fx / ours.width, real.fx / real.width
        if not (is_near and turn <= _SAME_ANGLE and abs(widths[0] / widths[1] - 1.0) <= _SAME_ANGLE):
            raise BackendError(
                "job_of_other_cameras",
                f"The job's camera of frame {frame} is not that of {truth.name}: what it made stands elsewhere.",
                hint="Reconstruct with --cameras and the cameras.json of the input camera.",
            )
