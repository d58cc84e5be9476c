"""All scores of a finished job."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from backend.contract.cameras import read_cameras
from backend.contract.errors import BackendError
from backend.contract.result import read_result
from backend.fit.scene import make_scene
from backend.fit.state import VolumeRecord
from backend.io.frame_stack import FrameStack
from backend.io.job_folder import JobFolder
from backend.io.particles import read_particles
from backend.io.records import RecordFile, open_stage_file
from backend.score.evaluate import evaluate
from backend.score.particles import ParticlePrediction, learned_buoyancy, mean_divergence
from backend.score.proposals import Proposals
from backend.score.truth_set import TruthSet


def score_job(folder: JobFolder, truth: TruthSet) -> dict[str, Any]:
    """What `evaluate` finds, and of the particles their divergence and buoyancy. Raises BackendError, also where the job is
    not finished or is of fewer frames than the scene shows: a mean over easier frames is no figure."""
    read_result(folder.path)
    with ExitStack() as stack:
        layers = FrameStack(stack.enter_context(open_stage_file(folder.smoke)), "smoke")
        anchor = make_scene(layers, read_cameras(folder.cameras)).anchor
        particles = stack.enter_context(read_particles(folder.particles))
        if particles.info.frame_start or particles.num_frames != truth.num_seen:
            raise BackendError(
                "job_of_other_frames",
                f"The job holds {particles.num_frames} frames from {particles.info.frame_start} on, the scene {truth.name} "
                f"shows {truth.num_seen}.",
                hint="Fit all frames of SCENE/input.",
            )
        proposals = None
        if "prior_fingerprint" in particles.info.provenance:  # else a volume.h5 is another job's
            records = stack.enter_context(RecordFile(folder.volume, VolumeRecord))
            proposals = Proposals(records, frame_start=particles.info.frame_start)
        scores = evaluate(ParticlePrediction(particles), truth, anchor=anchor, prior=proposals)
        return scores | {"divergence": mean_divergence(particles), "buoyancy": learned_buoyancy(particles)}
