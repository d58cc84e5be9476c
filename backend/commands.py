"""What each command of the command line does. Heavy imports wait until a command needs them."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from backend import __version__
from backend.contract import events
from backend.contract.cameras import Cameras, read_cameras
from backend.contract.errors import BackendError
from backend.contract.job import Job, checked_job, override, read_job
from backend.contract.result import RESULT_FILE, read_result
from backend.events_out import EventSink, StageReport, StopRequest
from backend.io.job_folder import JobFolder


def inspect_clip(options: argparse.Namespace, sink: EventSink, stop: StopRequest) -> None:
    """What a clip requires and why, and what each preset will cost: minutes, memory, quality. Nothing is fitted."""
    from backend.outlook import outlook_of

    start, end = options.frames or (None, None)
    job = checked_job(
        Job(
            video=absolute_video(options.video),
            preset=options.preset,
            cameras=None if options.cameras is None else str(Path(options.cameras).resolve()),
            frame_start=start,
            frame_stop=end,
            overrides=dict(options.overrides),
        )
    )
    outlook = outlook_of(job, StageReport("inspect", sink, stop))
    print(outlook.to_json() if options.json else outlook.to_text())


def reconstruct(options: argparse.Namespace, sink: EventSink, stop: StopRequest) -> None:
    """From a video to particles.h5 and a VDB sequence in the job folder. Run again, it resumes."""
    start, end = options.frames or (None, None)
    job = Job(
        video=absolute_video(options.video),
        preset=options.preset,
        cameras=None if options.cameras is None else str(Path(options.cameras).resolve()),
        frame_start=start,
        frame_stop=end,
        device=options.device,
        overrides=dict(options.overrides),
    )
    folder = JobFolder(options.job)
    checked_job(job)
    folder.create()
    folder.write_job(job)
    run(options, sink, stop)


def absolute_video(video: str) -> str:
    """The video's path as it will be found from anywhere."""
    return str(Path(video).absolute())


def run(options: argparse.Namespace, sink: EventSink, stop: StopRequest) -> None:
    """The job in DIR/job.json, to its end. One JSON event a line on standard output; a cancel on standard input."""
    from backend.pipeline import run_job

    began = time.monotonic()
    job = read_job(JobFolder(options.job).job)
    sink.send(events.Hello(protocol=events.PROTOCOL_VERSION, version=__version__, device=chosen_device(job.device)))
    run_job(options.job, sink, stop)
    sink.send(events.Done(result=RESULT_FILE, seconds=round(time.monotonic() - began, 3)))


def chosen_device(wanted: str) -> str:
    """The device that the job runs on. The fit's kernels are the CPU's; CUDA must at least be there to be asked for."""
    if wanted != "cuda":
        return "cpu"
    import torch

    if not torch.cuda.is_available():
        raise BackendError("no_cuda", "CUDA was asked for, but there is no CUDA device.", hint="Choose the device auto or cpu.")
    raise BackendError(
        "no_cuda", "This version computes on the CPU only.", hint="Choose the device auto or cpu; it takes minutes."
    )


def forecast(options: argparse.Namespace, sink: EventSink, stop: StopRequest) -> None:
    """The most likely N frames behind the fitted ones; they become part of the job's particles and VDB sequence."""
    folder = JobFolder(options.job)
    job = read_job(folder.job)
    overrides = {**job.overrides, "forecast.num_frames": options.frames}
    changed = Job(**{name: getattr(job, name) for name in job.__dataclass_fields__ if name != "overrides"}, overrides=overrides)
    checked_job(changed)
    folder.write_job(changed)
    run(options, sink, stop)


def render(options: argparse.Namespace, sink: EventSink, stop: StopRequest) -> None:
    """The smoke on black from any camera: sRGB premultiplied colour, fourth channel opacity."""
    from backend.io.particles import read_particles
    from backend.render.picture import render_frames

    result = read_result(options.job)
    report = StageReport("render", sink, stop)
    with read_particles(options.job / result.particles) as particles:
        first, last = video_frames(options.frames, result.frame_start, particles.num_frames + particles.num_forecast)
        cameras = read_cameras(options.cameras)
        wanted = [(frame, camera_index(cameras, frame, first, last)) for frame in range(first, last)]
        make_folder(options.out)
        sink.send(events.Stage(name="render", index=0, count=1))
        render_frames(particles, cameras, wanted, options.out, report, frame_start=result.frame_start)


def camera_index(cameras: Cameras, frame: int, first: int, last: int) -> int:
    """Which camera shows a video frame: the only one; the one of its number; or they are as many as are rendered."""
    count = len(cameras.camera_to_world)
    if count == 1:
        return 0
    if count >= last:
        return frame
    if count == last - first:
        return frame - first
    raise BackendError(
        "cameras_too_few",
        f"There are {count} cameras for the video frames {first} to {last - 1}.",
        hint="Give one camera, one for each video frame from 0, or one for each rendered frame.",
    )


def video_frames(wanted: tuple[int | None, int | None] | None, start: int, count: int) -> tuple[int, int]:
    """The video frames to work on, checked against those that the job holds."""
    first, last = wanted or (None, None)
    first = start if first is None else first
    last = start + count if last is None else last
    if not start <= first < last <= start + count:
        raise BackendError(
            "bad_frame_range",
            f"The job holds the video frames {start} to {start + count - 1}, not {first} to {last - 1}.",
            hint="Give A:B inside these, or forecast more frames first.",
        )
    return first, last


def make_folder(path: Path) -> None:
    """A folder for results, or a sentence on why not."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BackendError("not_writable", f"{path} cannot be made: {error}.", hint="Choose another folder.") from error


def export(options: argparse.Namespace, sink: EventSink, stop: StopRequest) -> None:
    """The VDB sequence once more, at another voxel size or for other frames."""
    from backend.io.particles import read_particles
    from backend.stages import export as export_stage

    result = read_result(options.job)
    config = override(read_job(JobFolder(options.job).job).config(), {"export.voxel_size": options.voxel_size}).export
    with read_particles(options.job / result.particles) as particles:
        first, last = video_frames(options.frames, result.frame_start, particles.num_frames + particles.num_forecast)
        make_folder(options.vdb)
        sink.send(events.Stage(name="export", index=0, count=1))
        report = StageReport("export", sink, stop)
        start, end = first - result.frame_start, last - result.frame_start
        frames = export_stage.run(particles, config, report, start=start, stop=end)
        for _ in export_stage.write_sequence(frames, options.vdb):
            pass


def simulate(options: argparse.Namespace, sink: EventSink, stop: StopRequest) -> None:
    """A physical rollout from the last frame, with wind, buoyancy and colliders: for looks, not for prediction.

    Writes JOB/simulation: particles.h5 and a VDB sequence.
    """
    from backend.simulation import simulate_job
    from backend.stages.simulate import Rollout

    began = time.monotonic()
    if options.frames < 1:
        raise BackendError("bad_frame_range", f"{options.frames} frames cannot be simulated.", hint="Give --frames 1 or more.")
    sink.send(events.Hello(protocol=events.PROTOCOL_VERSION, version=__version__, device="cpu"))
    rollout = Rollout(num_frames=options.frames, wind=options.wind, buoyancy=options.buoyancy)
    folder = simulate_job(options.job, rollout, options.collider, sink, stop)
    sink.send(events.Done(result=f"{folder.name}/particles.h5", seconds=round(time.monotonic() - began, 3)))


def report(options: argparse.Namespace, sink: EventSink, stop: StopRequest) -> None:
    """One picture: first, middle and last frame; input, reconstruction, and the same smoke from the side."""
    from backend.report import draw_report

    draw_report(options.job, options.out)
    print(json.dumps({"report": str(options.out)}))
