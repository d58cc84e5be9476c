"""The guard: two small jobs whose accuracy may not fall and whose work may not grow unnoticed.

    python -m benchmarks.guard                    how this checkout stands against the last entry; exit code 1 where it is worse
    python -m benchmarks.guard --add "Reason."    measure, and make that the entry to compare with; earlier ones are kept

docs/results/guard.json holds the entries. The ordinary tests compare with the last one (tests/guard).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from backend import kernel_setup  # noqa: F401 before numba loads
from backend.contract import events
from backend.contract.errors import BackendError
from backend.contract.job import Job
from backend.contract.result import CAMERAS_FILE
from backend.contract.truth import INPUT_FOLDER, SMOKE_VIDEO
from backend.events_out import StopRequest
from backend.io.atomic import write_text
from backend.io.job_folder import JobFolder
from backend.pipeline import run_job
from benchmarks.reconstruction import DOCS, SETS, code_digest
from benchmarks.trade_score import score_window
from benchmarks.work import counted

HISTORY = DOCS / "results" / "guard.json"
SCENE = SETS / "puff_front"
FRAMES = (82, 100)  # the camera turns enough for the prior to be asked
SMALL = {
    "follow_clip": False,
    "frames.working_size": 128,
    "physical.num_particles": 400,
    "visual.num_particles": 1500,
    "export.max_voxels": 64,
    "forecast.num_frames": 3,
}
CASES: dict[str, dict[str, Any]] = {"with the prior": {}, "without the prior": {"volume.use_prior": False}}
LARGEST_FALL = {  # of a score; others are kept for looking at
    "input_smoke_db": 0.3,
    "nvs_db": 0.3,
    "side_db": 0.3,
    "future_input_db": 0.3,
    "density_correlation": 0.01,
    "vdb_correlation": 0.01,
    "vdb_opacity_db": 0.3,
}
LARGEST_RISE = 0.15  # of any kind of work, relative


class Quiet:
    """Takes events and says nothing."""

    def send(self, event: events.Event) -> None:
        """Heard."""

    def close(self) -> None:
        """Nothing is held."""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--add", metavar="REASON", help="a sentence: why accuracy or work is what it is now")
    given = parser.parse_args(arguments)
    try:
        if given.add is not None:
            check_reason(given.add)
        with tempfile.TemporaryDirectory() as folder:
            found = {name: measure(changes, Path(folder)) for name, changes in CASES.items()}
        entries = history()
        for line in complaints(found, entries[-1]["cases"]) if entries else ():
            print(line)
        if given.add is None:
            is_worse = bool(entries) and any(complaints(found, entries[-1]["cases"]))
            print("worse than the last entry" if is_worse else "as good as the last entry" if entries else "there is no entry")
            return 1 if is_worse or not entries else 0
        write_text(HISTORY, as_text([*entries, {"reason": given.add, "code": code_digest(), "cases": found}]))
    except BackendError as error:
        print(f"wildsmoke: {error}", file=sys.stderr)
        return 2
    return 0


def measure(changes: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Scores and work of the small job with changes to its settings. folder: for the job; pictures in it are used again."""
    scene_input = SCENE / INPUT_FOLDER
    job = Job(
        video=str(scene_input / SMOKE_VIDEO),
        preset="draft",
        cameras=str(scene_input / CAMERAS_FILE),
        frame_start=FRAMES[0],
        frame_stop=FRAMES[1],
        device="cpu",
        overrides={**SMALL, **changes},
    )
    with tempfile.TemporaryDirectory(dir=folder) as path:
        job_folder = JobFolder(Path(path))
        job_folder.write_job(job)
        with counted() as work:
            run_job(job_folder.path, Quiet(), StopRequest())
        spent = dict(work)  # scoring draws pictures too
        return {"scores": score_window(job_folder, SCENE, folder / "pictures", scored=FRAMES), "work": spent}


def complaints(found: Mapping[str, Any], baseline: Mapping[str, Any]) -> Iterator[str]:
    """A sentence for each score that fell and each kind of work that rose by more than is allowed."""
    for case, after in found.items():
        before = baseline[case]
        for name, most in LARGEST_FALL.items():
            old, new = (each["scores"].get(name, float("-inf")) for each in (before, after))
            if new < old - most:
                yield f"{case}: {name} fell from {old:.4f} to {new:.4f}, by more than {most:g}."
        for kind, count in after["work"].items():
            most = (1.0 + LARGEST_RISE) * before["work"].get(kind, 0)
            if count > most:
                yield f"{case}: {kind} rose from {before['work'].get(kind, 0):,} to {count:,}, by more than {LARGEST_RISE:.0%}."


def history() -> list[dict[str, Any]]:
    """The entries, the oldest first."""
    return json.loads(HISTORY.read_text(encoding="utf-8")) if HISTORY.is_file() else []


def check_reason(reason: str) -> None:
    """Raises BackendError where it is no sentence."""
    if len(reason.split()) < 4 or not reason.endswith("."):
        raise BackendError(
            "no_reason", f'"{reason}" does not say why.', hint="Give a sentence, such as: Masses are found in fewer steps."
        )


def as_text(entries: list[dict[str, Any]]) -> str:
    """JSON with a line for each entry, so that an entry that is added adds a line."""
    return "[\n" + ",\n".join(json.dumps(entry, allow_nan=False) for entry in entries) + "\n]\n"


if __name__ == "__main__":
    raise SystemExit(main())
