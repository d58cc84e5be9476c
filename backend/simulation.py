"""`simulate`: a physical rollout of a finished job, written beside it as an asset of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from backend.contract import events
from backend.contract.cameras import read_cameras
from backend.contract.job import read_job
from backend.contract.result import PARTICLES_FILE, VDB_FOLDER, read_result
from backend.events_out import EventSink, StageReport, StopRequest
from backend.fit.lone import drawn_out
from backend.fit.state import PhysicalRecord, VisualRecord, particle_frame
from backend.geometry.camera import view_at
from backend.io.job_folder import JobFolder
from backend.io.particles import ParticlesWriter, read_particles
from backend.io.records import RecordFile
from backend.physics.mesh_collider import read_collider
from backend.stages import export, simulate

FOLDER = "simulation"  # in the job folder


def simulate_job(job: Path, rollout: simulate.Rollout, colliders: Sequence[str], sink: EventSink, stop: StopRequest) -> Path:
    """Roll on from the last fitted frame of a finished job. Returns the folder with particles.h5 and the VDB sequence."""
    folder = JobFolder(job)
    read_result(job)
    config = read_job(folder.job).config()
    rollout = replace(rollout, colliders=tuple(read_collider(path) for path in colliders))
    target = job / FOLDER
    target.mkdir(exist_ok=True)
    cameras = read_cameras(folder.cameras)
    sink.send(events.Stage(name="simulate", index=0, count=2))
    with (
        RecordFile(folder.physical, PhysicalRecord) as fluid,
        RecordFile(folder.visual, VisualRecord) as seen,
        read_particles(folder.particles) as fitted,
        ParticlesWriter(target / PARTICLES_FILE) as writer,
    ):
        report = StageReport("simulate", sink, stop)
        last = view_at(cameras, fitted.num_frames - 1)
        for record in simulate.run(fluid, seen, config.physical, rollout, report, seconds=1.0 / cameras.fps):
            writer.append(drawn_out(particle_frame(record), last))
        provenance = {
            **fitted.info.provenance,
            "simulation": {"wind": rollout.wind, "buoyancy": rollout.buoyancy, "colliders": len(colliders)},
        }
        still = replace(cameras, camera_to_world=cameras.camera_to_world[-1:])
        start = fitted.info.frame_start + fitted.num_frames
        writer.finish(replace(fitted.info, cameras=still, frame_start=start, provenance=provenance, fingerprint=""))
    sink.send(events.Artifact(kind="particles", path=f"{FOLDER}/{PARTICLES_FILE}"))
    sink.send(events.Stage(name="export", index=1, count=2))
    with read_particles(target / PARTICLES_FILE) as particles:
        for path in (target / VDB_FOLDER).glob("*.vdb"):
            path.unlink()
        frames = export.run(particles, config.export, StageReport("export", sink, stop))
        for frame, path in export.write_sequence(frames, target / VDB_FOLDER):
            sink.send(events.Artifact(kind="vdb", path=f"{FOLDER}/{VDB_FOLDER}/{path.name}", frame=frame))
    return target
