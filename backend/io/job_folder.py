"""The job folder: where each box of the data flow lies, and the fingerprints that tell whether it is up to date."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

from backend import __version__
from backend.contract import result
from backend.contract.decisions import DECISIONS_FILE
from backend.contract.errors import BackendError
from backend.contract.estimates import ESTIMATE_FILE
from backend.contract.job import Job
from backend.contract.units import STAGE_FORMAT_VERSION
from backend.io.atomic import storage_errors, write_text


class JobFolder:
    """Names inside one job folder."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.job = path / result.JOB_FILE
        self.result = path / result.RESULT_FILE
        self.log = path / result.LOG_FILE
        self.cameras = path / result.CAMERAS_FILE
        self.particles = path / result.PARTICLES_FILE
        self.vdb = path / result.VDB_FOLDER
        self.stages = path / "stages"
        self.frames = self.stages / "frames.h5"
        self.smoke = self.stages / "smoke.h5"
        self.volume = self.stages / "volume.h5"
        self.physical = self.stages / "physical.h5"
        self.visual = self.stages / "visual.h5"
        self.forecast = self.stages / "forecast.h5"
        self.plate = path / "background.png"
        self.timing = path / "timing.json"
        self.decisions = path / DECISIONS_FILE
        self.estimate = path / ESTIMATE_FILE

    def create(self) -> None:
        """Make the folder and see that it can be written to. Raises BackendError."""
        try:
            with storage_errors(self.path):
                self.stages.mkdir(parents=True, exist_ok=True)
                probe = self.path / "writable.part"
                probe.write_bytes(b"")
                probe.unlink()
        except (FileExistsError, NotADirectoryError) as error:
            raise BackendError(
                "not_a_folder", f"{self.path} is a file, not a folder.", hint="Choose another job folder."
            ) from error

    def write_job(self, job: Job) -> None:
        """job.json; a finished result of another job in the same folder ceases to be one."""
        text = job.to_json()
        if not (self.job.is_file() and self.job.read_text(encoding="utf-8") == text):
            self.result.unlink(missing_ok=True)
            write_text(self.job, text)


def fingerprint(stage: str, config: Any, *inputs: str | None) -> str:
    """Names what a stage would compute: its settings, its inputs, and the version of the code."""
    settings = dataclasses.asdict(config) if dataclasses.is_dataclass(config) and not isinstance(config, type) else config
    description = [stage, STAGE_FORMAT_VERSION, __version__, settings, list(inputs)]
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()


def file_fingerprint(path: str | Path) -> str:
    """The content of a small file."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise BackendError("file_missing", f"{path} cannot be read.", hint="Check the path.") from error
