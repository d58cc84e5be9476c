"""The pipeline: alone knows the order of the stages, keeps and resumes their files, and stops.

video -> decisions -> frames -> smoke layer -> cameras -> (volumes) -> physical -> visual particles -> forecast -> export
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from backend.asset import Asset
from backend.contract import events, running
from backend.contract.cameras import Cameras, read_cameras
from backend.contract.decisions import DECISIONS_FILE, read_decisions
from backend.contract.errors import BackendError
from backend.contract.estimates import ESTIMATE_FILE, kept_estimate
from backend.contract.job import Config, Job, read_job
from backend.contract.result import PARTICLES_FILE, VDB_FOLDER, Result, read_result
from backend.estimate.predict import estimate
from backend.estimate.time_left import TimeLeft
from backend.estimate.work import asks_prior
from backend.events_out import EventSink, StageReport, StopRequest
from backend.fit.state import PhysicalRecord, VisualRecord, VolumeRecord
from backend.io import images
from backend.io.atomic import storage_errors, whole_file, write_text
from backend.io.frame_stack import FrameStack, FrameStackWriter
from backend.io.hdf5_file import whole_hdf5
from backend.io.job_folder import JobFolder, file_fingerprint, fingerprint
from backend.io.particles import read_particles
from backend.io.records import RecordFile, RecordFolder, open_stage_file, read_stamp, stamp, write_records
from backend.io.video import Clip, open_clip
from backend.prior.weights import WEIGHTS, weights_fingerprint
from backend.stages import cameras as cameras_stage
from backend.stages import export, forecast, frames, inspect, physical, smoke, visual

STAGES = ("inspect", "frames", "smoke", "cameras", "volume", "physical", "visual", "forecast", "export")


def stages_of(config: Config) -> tuple[str, ...]:
    """The stages of a job with these settings, in order."""
    return STAGES if asks_prior(config) else tuple(name for name in STAGES if name != "volume")


def run_job(path: Path, sink: EventSink, stop: StopRequest, *, weights: Path = WEIGHTS) -> Result:
    """Run the job in a folder to its end, taking up what is there. Raises BackendError, Cancelled.

    weights: of the prior, where the settings ask it.
    """
    folder = JobFolder(path)
    job = read_job(folder.job)
    folder.create()
    pipeline = Pipeline(folder, job, sink, stop, weights=weights)
    other = running.running_pid(path)
    if other is not None:
        raise BackendError(
            "job_running",
            f"Another backend (process {other}) is at work in {path}.",
            hint="Wait for it, cancel it, or choose another job folder.",
        )
    with storage_errors(folder.path):
        running.mark_running(path)
    if not Path(os.environ["NUMBA_CACHE_DIR"]).is_dir():
        message = "First run of this version: the kernels are compiled as they are needed, which takes about a minute in all."
        sink.send(events.Warning(code="first_run", message=message))
    try:
        return pipeline.run()
    except BackendError as error:
        error.stage = error.stage or pipeline.stage or None
        raise
    finally:
        running.unmark_running(path)


class Pipeline:
    """One run of one job. Each method is one arrow of the data flow and returns the fingerprint of what it made."""

    def __init__(self, folder: JobFolder, job: Job, sink: EventSink, stop: StopRequest, *, weights: Path = WEIGHTS) -> None:
        self.folder = folder
        self.job = job
        self.config: Config = job.config()
        self.stages = stages_of(self.config)
        self.weights = weights
        self.weights_mark: str | None = None
        self.sink = sink
        self.stop = stop
        self.stage = ""
        self.seconds: dict[str, float] = {}
        self.time_left = TimeLeft({})

    def run(self) -> Result:
        given = None if self.job.cameras is None else read_cameras(self.job.cameras)
        with open_clip(self.job.video, frame_rate=self.config.frames.frame_rate) as clip:
            source = clip.fingerprint
            self._inspect(clip, given)
            frames_mark = self._frames(clip)
            smoke_mark = self._smoke(frames_mark, has_alpha=clip.has_alpha)
            cameras_mark = self._cameras(smoke_mark, given, size=(clip.width, clip.height))
        volume_marks = self._volume(smoke_mark, cameras_mark)
        physical_mark = self._physical(smoke_mark, cameras_mark, *volume_marks)
        visual_mark = self._visual(smoke_mark, cameras_mark, physical_mark, *volume_marks)
        forecast_mark = self._forecast(smoke_mark, cameras_mark, visual_mark)
        result = self._export(source, cameras_mark, visual_mark, forecast_mark)
        write_text(self.folder.timing, json.dumps(self.seconds, indent=2))
        return result

    def _inspect(self, clip: Clip, given: Cameras | None) -> None:
        """Decide what the clip requires, and go on with settings that say so."""
        start, stop = frames.frame_range(clip, self.job.frame_start, self.job.frame_stop)
        cameras, chosen = given.to_json() if given else None, sorted(self.job.overrides)
        by_user = [key for key in inspect.KEYS if key in chosen]
        inputs = (clip.fingerprint, str(start), str(stop), cameras, *by_user, *self._given_images())
        mark = fingerprint("inspect", inspect.settings_of(self.config), *inputs)

        def write(report: StageReport) -> None:
            decisions, seen = inspect.run(clip, self.config, report, chosen=chosen, start=start, stop=stop, given=given)
            for entry in decisions.warnings:
                report.warning(entry.code, entry.message)
            expected = estimate(seen, decisions.followed(self.config), preset=self.job.preset, chosen=chosen)
            write_text(self.folder.estimate, replace(expected, fingerprint=mark).to_json())
            write_text(self.folder.decisions, replace(decisions, fingerprint=mark).to_json())

        self._stage("inspect", mark, _json_entry(self.folder.decisions, "fingerprint"), write)
        decisions = read_decisions(self.folder.path)
        self.config = decisions.followed(self.config)
        self.stages = stages_of(self.config)
        self.weights_mark = weights_fingerprint(self.weights) if asks_prior(self.config) else None
        expected = kept_estimate(self.folder.path, fingerprint=mark)
        ahead = self.stages[1:]
        self.time_left = TimeLeft({name: expected.stages.get(name, 0.0) for name in ahead} if expected is not None else {})
        self.sink.send(events.Artifact(kind="decisions", path=DECISIONS_FILE))
        if expected is not None:
            self.sink.send(events.Artifact(kind="estimate", path=ESTIMATE_FILE))

    def _frames(self, clip: Clip) -> str:
        config = self.config.frames
        start, stop = frames.frame_range(clip, self.job.frame_start, self.job.frame_stop)
        mark = fingerprint("frames", config, clip.fingerprint, str(start), str(stop))

        def write(report: StageReport) -> None:
            width, height = frames.working_size(clip, config)
            with whole_hdf5(self.folder.frames) as file:
                stack = FrameStackWriter(file, "frames", stop - start, (height, width, 4))
                for image in frames.run(clip, config, report, frame_start=start, frame_stop=stop):
                    stack.append(image)
                file.attrs["fps"] = clip.fps
                file.attrs["frame_start"] = start
                stamp(file, mark)

        self._stage("frames", mark, read_stamp(self.folder.frames), write)
        return mark

    def _smoke(self, frames_mark: str, *, has_alpha: bool) -> str:
        config = self.config.extraction
        mark = fingerprint("smoke", config, frames_mark, str(has_alpha), *self._given_images())

        def write(report: StageReport) -> None:
            with open_stage_file(self.folder.frames) as source:
                stack = FrameStack(source, "frames")
                layer = smoke.run(stack, config, report, has_alpha=has_alpha)
                self.folder.plate.unlink(missing_ok=True)
                if layer.plate is not None:
                    with whole_file(self.folder.plate) as part:
                        images.write_png(part, layer.plate)
                with whole_hdf5(self.folder.smoke) as file:
                    out = FrameStackWriter(file, "smoke", len(stack), stack.shape)
                    for image in layer.frames:
                        out.append(image)
                    for name in ("fps", "frame_start"):
                        file.attrs[name] = source.attrs[name]
                    file.attrs["mode"] = layer.mode
                    file.attrs["reason"] = layer.reason
                    file.attrs["measured"] = json.dumps(layer.measured, sort_keys=True)
                    file.attrs["smoke_color"] = np.asarray(layer.smoke_color, np.float32)
                    stamp(file, mark)

        self._stage("smoke", mark, read_stamp(self.folder.smoke), write)
        return mark

    def _cameras(self, smoke_mark: str, given: Cameras | None, *, size: tuple[int, int]) -> str:
        mark = fingerprint("cameras", self.config.cameras, smoke_mark, given.to_json() if given else None)

        def write(report: StageReport) -> None:
            with open_stage_file(self.folder.frames) as source, open_stage_file(self.folder.smoke) as layer:
                stack, layers = FrameStack(source, "frames"), FrameStack(layer, "smoke")
                solved = cameras_stage.run(
                    num_frames=len(stack),
                    frame_start=int(source.attrs["frame_start"]),  # type: ignore[arg-type]
                    size=size,
                    fps=float(source.attrs["fps"]),  # type: ignore[arg-type]
                    config=self.config.cameras,
                    given=given,
                    motion=lambda: cameras_stage.measure_motion(stack, report, smoke=layers),
                    report=report,
                )
            data = {**json.loads(solved.to_json()), "fingerprint": mark}
            write_text(self.folder.cameras, json.dumps(data, allow_nan=False))

        self._stage("cameras", mark, _json_entry(self.folder.cameras, "fingerprint"), write)
        return mark

    def _volume(self, smoke_mark: str, cameras_mark: str) -> tuple[str, ...]:
        """What the particles follow from besides, in a tuple; an empty one where the prior is not asked."""
        if self.weights_mark is None:
            return ()
        mark = fingerprint("volume", self.config.volume, self.weights_mark, smoke_mark, cameras_mark)

        def write(report: StageReport) -> None:
            from backend.prior.predict import Prior  # torch: two seconds that other jobs need not wait
            from backend.stages import volume

            settings = self.config.volume
            with open_stage_file(self.folder.smoke) as file:
                layers, cameras = FrameStack(file, "smoke"), read_cameras(self.folder.cameras)
                plan = volume.make_plan(
                    layers, cameras, stride=settings.stride, every=settings.every, finer=settings.finer,
                    as_wide=settings.as_deep_as_wide,
                )  # fmt: skip
            parts = RecordFolder(self.folder.volume.with_suffix(".parts"), mark, VolumeRecord)
            if plan is None:
                write_records(self.folder.volume, mark, ())
            else:
                prior = Prior(self.weights)
                plan = volume.centred(plan, report, prior=prior, num_done=len(parts))
                _keep(parts, volume.propose(plan, report, prior=prior, done=parts))
                records = volume.run(plan, report, parts, levels=prior.levels, shares=prior.shares)
                write_records(self.folder.volume, mark, records)
            parts.remove()

        self._stage("volume", mark, read_stamp(self.folder.volume), write)
        return (mark,)

    def _volumes(self) -> AbstractContextManager[RecordFile[VolumeRecord] | None]:
        """What the prior proposes, open for reading; None where it is not asked."""
        return nullcontext() if self.weights_mark is None else RecordFile(self.folder.volume, VolumeRecord)

    def _physical(self, smoke_mark: str, cameras_mark: str, *volume_marks: str) -> str:
        inputs = (smoke_mark, cameras_mark, *volume_marks, *self._method_marks())
        mark = fingerprint("physical", self.config.physical, str(self.config.seed), *inputs)

        def write(report: StageReport) -> None:
            with open_stage_file(self.folder.smoke) as file, self._volumes() as volumes:
                layers = FrameStack(file, "smoke")
                parts = RecordFolder(self.folder.physical.with_suffix(".parts"), mark, PhysicalRecord)
                records = physical.run(
                    layers, read_cameras(self.folder.cameras), self.config.physical, report, seed=self.config.seed,
                    done=parts, method=self.config.method, published=self.config.published, volumes=volumes,
                )  # fmt: skip
                _keep(parts, records)
            write_records(self.folder.physical, mark, parts)
            parts.remove()

        self._stage("physical", mark, read_stamp(self.folder.physical), write)
        return mark

    def _visual(self, smoke_mark: str, cameras_mark: str, physical_mark: str, *volume_marks: str) -> str:
        inputs = (smoke_mark, cameras_mark, physical_mark, *volume_marks, *self._method_marks())
        mark = fingerprint("visual", self.config.visual, str(self.config.seed), *inputs)

        def write(report: StageReport) -> None:
            with (
                open_stage_file(self.folder.smoke) as file,
                RecordFile(self.folder.physical, PhysicalRecord) as fluid,
                self._volumes() as volumes,
            ):
                layers = FrameStack(file, "smoke")
                parts = RecordFolder(self.folder.visual.with_suffix(".parts"), mark, VisualRecord)
                records = visual.run(
                    layers, read_cameras(self.folder.cameras), fluid, self.config.visual, report, seed=self.config.seed,
                    done=parts, method=self.config.method, published=self.config.published, volumes=volumes,
                    as_wide=self.config.volume.as_deep_as_wide,
                )  # fmt: skip
                _keep(parts, records)
            write_records(self.folder.visual, mark, parts)
            parts.remove()

        self._stage("visual", mark, read_stamp(self.folder.visual), write)
        return mark

    def _forecast(self, smoke_mark: str, cameras_mark: str, visual_mark: str) -> str:
        config = self.config.forecast
        mark = fingerprint("forecast", config, smoke_mark, cameras_mark, visual_mark)

        def write(report: StageReport) -> None:
            with (
                open_stage_file(self.folder.smoke) as file,
                RecordFile(self.folder.physical, PhysicalRecord) as fluid,
                RecordFile(self.folder.visual, VisualRecord) as seen,
                self._volumes() as volumes,
            ):
                layers = FrameStack(file, "smoke")
                records = forecast.run(
                    layers, read_cameras(self.folder.cameras), fluid, seen, config, report,
                    method=self.config.method, published=self.config.published, volumes=volumes,
                )  # fmt: skip
                write_records(self.folder.forecast, mark, records)

        self._stage("forecast", mark, read_stamp(self.folder.forecast), write)
        return mark

    def _export(self, source: str, cameras_mark: str, visual_mark: str, forecast_mark: str) -> Result:
        mark = fingerprint("export", self.config.export, source, cameras_mark, visual_mark, forecast_mark)

        def write(report: StageReport) -> None:
            asset = Asset(folder=self.folder, preset=self.job.preset, config=self.config, weights_mark=self.weights_mark)
            asset.write_particles(source, visual_mark, forecast_mark)
            self.sink.send(events.Artifact(kind="particles", path=PARTICLES_FILE))
            with read_particles(self.folder.particles) as particles:
                plan = export.plan_export(particles, self.config.export, report)
                existing = self._prepare_sequence(mark)
                frames_out = export.run(particles, self.config.export, report, plan=plan, existing=existing)
                for frame, path in export.write_sequence(frames_out, self.folder.vdb):
                    self.sink.send(events.Artifact(kind="vdb", path=f"{VDB_FOLDER}/{path.name}", frame=frame))
                warnings = [entry for entries in self._all_warnings().values() for entry in entries]
                result = asset.result(particles, plan, mark, warnings=warnings)
            write_text(self.folder.result, result.to_json())

        found = _json_entry(self.folder.result, "fingerprint")
        self._stage("export", mark, found, write)
        return read_result(self.folder.path)

    def _prepare_sequence(self, mark: str) -> set[int]:
        """The frames of the VDB sequence that are there already; those of another export are removed first."""
        note = self.folder.vdb / "sequence.json"
        if _json_entry(note, "fingerprint") != mark:
            shutil.rmtree(self.folder.vdb, ignore_errors=True)
            self.folder.vdb.mkdir()
            write_text(note, json.dumps({"fingerprint": mark}))
        paths = self.folder.vdb.glob("smoke_*.vdb")
        return {int(path.stem.rpartition("_")[2]) - 1 for path in paths}

    # -- bookkeeping ----------------------------------------------------------------------------------------------

    def _given_images(self) -> list[str | None]:
        """The content of the images that the artist gave for the extraction."""
        config = self.config.extraction
        paths = (config.clean_plate, config.garbage_matte, config.smoke_mask)
        return [file_fingerprint(path) if path else None for path in paths]

    def _method_marks(self) -> tuple[str, ...]:
        """What the particles follow from besides; nothing for the default, whose files stay valid."""
        if self.config.method == "default":
            return ()
        return (self.config.method, json.dumps(asdict(self.config.published), sort_keys=True))

    def _stage(self, name: str, mark: str, found: str | None, write: Callable[[StageReport], None]) -> None:
        """Announce a stage, and do it unless its file is there. A stage that is done anew ends the old result."""
        self.stop.check()
        self.stage = name
        is_done = found == mark
        left = self.time_left.begin(name, time.monotonic(), is_skipped=is_done)
        index, count = self.stages.index(name), len(self.stages)
        self.sink.send(events.Stage(name=name, index=index, count=count, skipped=is_done, job_seconds_left=left))
        kept = _json_entry(self._warnings_path, name)
        if is_done:
            for entry in kept or []:
                self.sink.send(events.Warning(**entry))
            return
        self.folder.result.unlink(missing_ok=True)
        report = StageReport(name, self.sink, self.stop, time_left=self.time_left)
        began = time.monotonic()
        with storage_errors(self.folder.path):
            write(report)
            self.seconds[name] = round(time.monotonic() - began, 3)
            write_text(self._warnings_path, json.dumps({**self._all_warnings(), name: report.warnings}))

    @property
    def _warnings_path(self) -> Path:
        return self.folder.stages / "warnings.json"

    def _all_warnings(self) -> dict[str, list[dict[str, str]]]:
        return {name: _json_entry(self._warnings_path, name) or [] for name in self.stages}


def _keep(parts: RecordFolder[Any], records: Iterator[Any]) -> None:
    """Store each frame as it comes, behind those that are there."""
    for frame, record in enumerate(records, start=len(parts)):
        parts.save(frame, record)


def _json_entry(path: Path, name: str) -> Any:
    """One entry of a JSON file; None if there is no such file or entry, or it is damaged (it is then made anew)."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return data.get(name) if isinstance(data, dict) else None
