"""What seconds buy: every setting that costs time against accuracy, time and memory, on short parts of the tuning scenes.

    python3 wildsmoke.py bench --out DIR [--scenes a,b] [--frames A:B] [--threads N] [--only TEXT] [--page]

Each cell is a job of its own under DIR; what is there is not made again, so that an interrupted run goes on. At its default
size it takes up to an hour on two cores. DIR/trade.json gathers every cell; `--page` copies it to docs/results, draws the plots
and makes docs/trade.md. Jobs run on one thread each, but for those that measure threads. Truth is read after a job is done.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from backend import __version__
from backend.contract.errors import BackendError
from backend.contract.job import PRESETS, preset_config
from backend.contract.result import PARTICLES_FILE, RESULT_FILE, VDB_FOLDER
from backend.contract.truth import TRUTH_FILE, TRUTH_FOLDER
from backend.io.atomic import write_text
from backend.prior.weights import weights_fingerprint
from benchmarks.cost import CHECKOUT
from benchmarks.reconstruction import DOCS, PACKAGES, SETS, UNTOUCHED, as_text, code_digest, machine, run_module, version
from benchmarks.trade_front import totals
from benchmarks.trade_plan import FRAMES, Sweep, Trial, compared, sweeps, with_donors

SCENES = ("puff_front", "steady_plume")  # two of the three that presets are tuned on: a thin front and a thick plume
RESULTS_FILE = "trade.json"
EXPORTED = (PARTICLES_FILE, VDB_FOLDER, RESULT_FILE)  # never taken over: what is left of it would make another export look cheap


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A trial on a scene; root: the folder of all."""

    root: Path
    scene: Path
    trial: Trial

    @property
    def record(self) -> Path:
        return self.root / "cells" / self.scene.name / f"{self.trial.name.replace(' ', '_')}.json"

    @property
    def job(self) -> Path:
        return self.root / "jobs" / self.scene.name / self.trial.name.replace(" ", "_")

    @property
    def donor(self) -> Cell | None:
        return None if self.trial.donor is None else Cell(root=self.root, scene=self.scene, trial=self.trial.donor)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--from", dest="source", type=Path, default=SETS, help="the folder of the scenes")
    parser.add_argument("--scenes", type=lambda text: text.split(","), default=list(SCENES))
    parser.add_argument("--frames", type=frame_range, default=FRAMES, metavar="A:B", help="frames A to B-1 of each")
    parser.add_argument("--threads", type=int, default=num_processors(), help="the most that is tried")
    parser.add_argument("--only", default="", metavar="TEXT", help="trials whose name holds this, and what they take from")
    parser.add_argument("--page", action="store_true", help="also docs/trade.md, its figures and its plots")
    given = parser.parse_args(arguments)
    root = given.out.resolve()
    swept = sweeps(threads=given.threads, frames=given.frames)
    groups = [compared(frames=given.frames), [trial for sweep in swept for _, trial in sweep.points]]
    near, around = (with_donors(trial for trial in group if given.only in trial.name) for group in groups)
    try:
        scenes = [scene_folder(given.source, name) for name in given.scenes]
        pairs = [(scene, trial) for trial in near for scene in scenes] + [(scene, trial) for scene in scenes for trial in around]
        failures = measure([Cell(root=root, scene=scene, trial=trial) for scene, trial in dict.fromkeys(pairs)])
        compare_trivial(root, scenes, given.frames)
        results = gather(root, swept)
    except BackendError as error:
        print(f"wildsmoke: {error}", file=sys.stderr)
        return 2
    write_text(root / RESULTS_FILE, as_text(results))
    if given.page:
        write_text(DOCS / "results" / RESULTS_FILE, as_text(results))
        run_module("benchmarks.trade_figures")
        run_module("tools.trade_page")
    return 1 if failures else 0


def frame_range(text: str) -> tuple[int, int]:
    first, _, stop = text.partition(":")
    return int(first), int(stop)


def num_processors() -> int:
    """Those that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def scene_folder(source: Path, name: str) -> Path:
    """Raises BackendError where it is no scene, or one that nothing may be tuned on."""
    folder = (source / name).resolve()
    if not (folder / TRUTH_FOLDER / TRUTH_FILE).is_file():
        raise BackendError("truth_missing", f"{folder} holds no benchmark scene.", hint="Give a folder that `synth ship` made.")
    if name in UNTOUCHED:
        raise BackendError(
            "scene_untouched",
            f"{name} is kept for figures: presets are chosen by what is measured here.",
            hint="Give other scenes; `python -m benchmarks.reconstruction` scores the presets on all of them.",
        )
    return folder


def measure(cells: Sequence[Cell]) -> int:
    """Make what is missing. Returns how many could not be made; each says why. Raises BackendError where cells were made by
    other sources."""
    missing = [cell for cell in cells if not is_made(cell)]
    columns = (TextColumn("{task.description:<46}"), BarColumn(bar_width=20), TextColumn("{task.completed}/{task.total}"))
    console, failures = Console(stderr=True, highlight=False), 0
    if missing:
        warm_up(missing)
    with Progress(*columns, TimeElapsedColumn(), TextColumn("{task.fields[left]}"), console=console) as progress:
        task = progress.add_task("bench", total=len(cells), completed=len(cells) - len(missing), left="")
        began = time.monotonic()
        for number, cell in enumerate(missing):
            title = f"{cell.scene.name} {cell.trial.name}"
            left = "" if number == 0 else f"{(time.monotonic() - began) / number * (len(missing) - number) / 60:.0f} min left"
            progress.update(task, description=title[:46], left=left)
            try:
                make(cell)
            except RuntimeError as error:  # the others are made all the same
                console.print(f"{title}: {error}", markup=False)
                failures += 1
            progress.advance(task)
            if not console.is_terminal:
                print(
                    f"{len(cells) - len(missing) + number + 1}/{len(cells)} {cell.scene.name} {cell.trial.name} {left}",
                    flush=True,
                )
    return failures


def is_made(cell: Cell) -> bool:
    """Whether its record is there. Raises BackendError where it was made by other sources or weights or of other frames: ratios
    between them would be of nothing."""
    if not cell.record.exists():
        return False
    found = json.loads(cell.record.read_text(encoding="utf-8"))
    if (found["code"], found["weights"]) != (code_digest(), weights_fingerprint()):
        raise BackendError(
            "other_sources", f"{cell.record.parent} holds what other sources or weights made.", hint="Choose another --out."
        )
    if found["frames"] != list(cell.trial.frames):
        raise BackendError("other_frames", f"{cell.record} is of the frames {found['frames']}.", hint="Choose another --out.")
    return True


def warm_up(cells: Sequence[Cell]) -> None:
    """Machine code of the kernels is made and kept before anything is measured: a few frames, with and without the prior."""
    trial, root = cells[0].trial, cells[0].root
    root.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="warm_up_", dir=root))  # others may be at work on other scenes
    for changes in ((), (("volume.use_prior", "false"),)):
        stop = min(trial.frames[0] + 4, trial.frames[1])
        short = Trial(preset=PRESETS[0], changes=changes, frames=(trial.frames[0], stop), scored_from=trial.frames[0])
        with_folder = Cell(root=folder, scene=cells[0].scene, trial=short)
        run(with_folder, with_folder.record)
    shutil.rmtree(folder)


def make(cell: Cell) -> None:
    """The record of a cell, from a job that is made anew but for what its donor holds. Raises RuntimeError."""
    shutil.rmtree(cell.job, ignore_errors=True)  # left by a run that was interrupted: its times would count for nothing
    donor = cell.donor
    if donor is not None:
        if not donor.job.is_dir():
            make(donor)
        shutil.copytree(donor.job, cell.job, ignore=shutil.ignore_patterns(*EXPORTED))
    run(cell, cell.record)
    if donor is not None or cell.trial.repeat:
        shutil.rmtree(cell.job)


def run(cell: Cell, record: Path) -> None:
    """In a process of its own, on as many threads as the trial says. Raises RuntimeError with its last words."""
    donor = cell.donor
    record.parent.mkdir(parents=True, exist_ok=True)
    facts = {"scene": cell.scene.name, "name": cell.trial.name, **asdict(cell.trial), "load": round(os.getloadavg()[0], 2)}
    facts |= {"code": code_digest(), "weights": weights_fingerprint()}
    order = {
        "scene": str(cell.scene),
        "job": str(cell.job),
        "record": str(record),
        "donor": None if donor is None or not donor.record.exists() else str(donor.record),
        "pictures": str(cell.root / "pictures"),
        "trial": asdict(cell.trial),
        "facts": facts,
        "began": time.monotonic(),  # the same clock in all processes
    }
    names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    environment = {**os.environ, **dict.fromkeys(names, str(cell.trial.threads)), "PYTHONPATH": str(CHECKOUT)}
    command = [sys.executable, "-m", "benchmarks.trade_cell", json.dumps(order)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=CHECKOUT, env=environment, check=False)
    if done.returncode != 0:
        raise RuntimeError((done.stderr.strip().splitlines() or [f"ended with code {done.returncode}"])[-1])


def compare_trivial(root: Path, scenes: Sequence[Path], frames: tuple[int, int]) -> None:
    """A record of what needs no reconstruction, of each scene that has none yet."""
    for scene in scenes:
        record = root / "trivial" / f"{scene.name}.json"
        if not record.exists():
            record.parent.mkdir(parents=True, exist_ok=True)
            options = ("--pictures", root / "pictures", "--frames", f"{frames[0]}:{frames[1]}", "--out", record)
            run_module("benchmarks.trade_score", scene, *options)


def with_shared_costs(cells: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Stages that a cell took over cost what its donor's record says, also where that was measured again."""
    names = [field.name for field in fields(Trial)]
    stages = {(cell["scene"], cell["name"]): cell["stages"] for cell in cells}
    found = []
    for cell in cells:
        facts = {name: cell[name] for name in names}
        changes = tuple((key, value) for key, value in cell["changes"])
        donor = Trial(**{**facts, "changes": changes, "frames": tuple(cell["frames"])}).donor
        theirs = stages.get((cell["scene"], donor.name), {}) if donor else {}
        taken = [name for name, stage in cell["stages"].items() if stage["is_taken_over"] and name in theirs]
        found.append({**cell, "stages": {**cell["stages"], **{name: {**theirs[name], "is_taken_over": True} for name in taken}}})
    return found


def gather(root: Path, swept: Sequence[Sweep]) -> dict[str, Any]:
    """All cells of a folder, on which machine, with which versions and settings."""
    cells = [json.loads(path.read_text(encoding="utf-8")) for path in sorted((root / "cells").glob("*/*.json"))]
    cells = [{**cell, **totals(cell["stages"])} for cell in with_shared_costs(cells)]
    versions = {"wildsmoke": __version__, "python": platform.python_version(), **{name: version(name) for name in PACKAGES}}
    plan = [
        {
            "key": sweep.key,
            "base": sweep.base,
            "stage": sweep.stage,
            "is_exponent": sweep.is_exponent,
            "points": [[value, trial.name] for value, trial in sweep.points],
        }
        for sweep in swept
    ]
    settings = {name: asdict(preset_config(name)) for name in PRESETS}
    trivial = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted((root / "trivial").glob("*.json"))}
    facts = {"machine": machine(), "versions": versions, "settings": settings, "trivial": trivial}
    return {**facts, "sweeps": plan, "cells": cells}


if __name__ == "__main__":
    raise SystemExit(main())
