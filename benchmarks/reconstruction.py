"""The benchmark set by every method at every preset: fitted from smoke on black with its true cameras, forecast, and scored.

    python -m benchmarks.reconstruction --out DIR [--presets draft,preview,final] [--methods default,as_published,fluidnexus]
        [--scenes a,b] [--set section.field=value ...] [--again fit|scores] [--from SET] [--json FILE] [--page]

What is read: SCENE/input. What it is scored on: SCENE/truth. A cell of the matrix is a job DIR/PRESET/METHOD/SCENE and, beside
it, SCENE.json: what it cost, then its scores. What is there is not made again, and a job that was interrupted goes on; its
times then count for nothing. DIR/results.json gathers every cell of DIR, `--json` writes it without the figures of single
frames; `--page` puts that into docs/results, draws the pictures and makes docs/results.md. One DIR holds one state of settings
and weights; another one is refused, or made with `--again`.
Nothing is tuned on scenes marked as untouched.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from backend import __version__
from backend.contract.errors import BackendError
from backend.contract.job import METHODS, PRESETS, override, preset_config
from backend.contract.result import CAMERAS_FILE
from backend.contract.truth import INPUT_FOLDER, SMOKE_VIDEO, TRUTH_FILE, TRUTH_FOLDER
from backend.io.atomic import write_text
from backend.prior.weights import weights_fingerprint
from backend.score.compare import best_trivial
from benchmarks.cost import CHECKOUT, run_backend
from synthetic.scenes import towards_sun

DOCS = CHECKOUT / "docs"
SETS = CHECKOUT / "synthetic" / "bench"
UNTOUCHED = ("obstacle_plume", "wind_wisp")  # for figures; nothing is tuned on them
RESULTS_FILE = "results.json"
PACKAGES = ("numpy", "numba", "scipy", "torch", "opencv-python-headless")


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One job of the matrix; root: the folder of all."""

    root: Path
    preset: str
    method: str
    scene: Path

    @property
    def job(self) -> Path:
        return self.root / self.preset / self.method / self.scene.name

    @property
    def record(self) -> Path:
        return self.job.with_name(f"{self.scene.name}.json")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--from", dest="source", type=Path, default=SETS)
    for name, choices in (("presets", PRESETS), ("methods", METHODS)):
        parser.add_argument(f"--{name}", type=lambda text: text.split(","), default=list(choices))
    parser.add_argument("--scenes", type=lambda text: text.split(","), help="all without it")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="section.field=value")
    parser.add_argument("--again", choices=("fit", "scores"), help="make what was asked for once more")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--page", action="store_true", help="also docs/results.md, its figures and its pictures")
    given = parser.parse_args(arguments)
    root, failures = given.out.resolve(), 0
    scenes = given.scenes or sorted(path.parents[1].name for path in given.source.glob(f"*/{TRUTH_FOLDER}/{TRUTH_FILE}"))
    for preset in given.presets:
        for scene in scenes:
            for method in given.methods:
                cell = Cell(root=root, preset=preset, method=method, scene=(given.source / scene).resolve())
                try:
                    found = complete(cell, given.settings, again=given.again)
                    print(json.dumps(summary(found)), flush=True)
                except (BackendError, RuntimeError, subprocess.CalledProcessError) as error:  # the others are made all the same
                    print(f"{preset} {method} {scene}: {error}", file=sys.stderr, flush=True)
                    failures += 1
    try:
        results = gather(root)
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 1
    write_text(root / RESULTS_FILE, as_text(results))
    if not results["cells"]:
        return 1
    short = as_text({**results, "cells": [without_frames(cell) for cell in results["cells"]]})
    for path in (given.json, DOCS / "results" / "reconstruction.json" if given.page else None):
        if path is not None:
            write_text(path, short)
    if given.page:
        run_module("benchmarks.reconstruction_figures", root, "--out", DOCS / "images", "--from", given.source.resolve())
        run_module("tools.results")
        run_module("tools.estimate_quality")
    return 1 if failures else 0


def run_module(name: str, *arguments: str | Path) -> None:
    """In a process of its own: this one stays small, see benchmarks/cost.py. Raises CalledProcessError."""
    command = [sys.executable, "-m", name, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=CHECKOUT, env=environment)


def complete(cell: Cell, settings: list[str], *, again: str | None = None) -> dict[str, Any]:
    """What is known of a cell, after whatever was missing of it was made. Raises RuntimeError where that does not work, and
    CalledProcessError where scoring does not."""
    truth = json.loads((cell.scene / TRUTH_FOLDER / TRUTH_FILE).read_text(encoding="utf-8"))
    ahead = int(truth["frames"]["count"]) - int(truth["frames"]["seen"])
    changes = dict(text.split("=", 1) for text in (f"method={cell.method}", f"forecast.num_frames={ahead}", *settings))
    config = override(preset_config(cell.preset), changes)
    asks_prior = config.volume.use_prior and config.method == "default"
    facts = {"settings": asdict(config), "weights": weights_fingerprint() if asks_prior else None}
    kept: dict[str, Any] = json.loads(cell.record.read_text(encoding="utf-8")) if cell.record.exists() else {}
    if again == "fit":
        cell.record.unlink(missing_ok=True)  # first: without it nobody takes what is left of the job for whole
        shutil.rmtree(cell.job, ignore_errors=True)
        kept = {}
    if kept and {name: kept[name] for name in facts} != facts:
        raise RuntimeError("was made with other settings or weights: choose another --out, or --again fit")
    if not kept:
        options = [part for key, value in changes.items() for part in ("--set", f"{key}={value}")]
        clip, cameras = (cell.scene / INPUT_FOLDER / name for name in (SMOKE_VIDEO, CAMERAS_FILE))
        cost = run_backend("reconstruct", clip, "--job", cell.job, "--cameras", cameras, "--preset", cell.preset, *options)
        where = {"scene": cell.scene.name, "method": cell.method, "preset": cell.preset}
        kept = {**where, "untouched": cell.scene.name in UNTOUCHED, **facts, "code": code_digest(), "cost": asdict(cost)}
        write_text(cell.record, json.dumps(kept))
    if "scores" not in kept or again == "scores":
        kept["scores"] = scores_of(cell)
        write_text(cell.record, json.dumps(kept))
    return kept


def scores_of(cell: Cell) -> dict[str, Any]:
    part = cell.record.with_suffix(".scores.part")
    run_module("backend", "evaluate", "--job", cell.job, "--truth", cell.scene, "--out", part)
    scores = json.loads(part.read_text(encoding="utf-8"))
    part.unlink()
    if scores["light"]:
        scores["light"]["degrees_from_sun"] = degrees_between(scores["light"]["direction"], towards_sun())
    return scores


def degrees_between(a: Sequence[float], b: Sequence[float]) -> float | None:
    """None where one has no direction."""
    size = math.hypot(*a) * math.hypot(*b)
    if not size > 0.0:
        return None
    cosine = sum(x * y for x, y in zip(a, b, strict=True)) / size
    return round(math.degrees(math.acos(min(max(cosine, -1.0), 1.0))), 2)


def gather(root: Path) -> dict[str, Any]:
    """All cells of a folder that have scores, on which machine, with which versions and settings. Raises RuntimeError where
    cells of one preset and method were made with different settings: their mean would be of nothing."""
    cells = [
        cell
        for preset in PRESETS
        for method in METHODS
        for path in sorted((root / preset / method).glob("*.json"))
        if "scores" in (cell := json.loads(path.read_text(encoding="utf-8")))
    ]
    settings: dict[str, dict[str, Any]] = {}
    for cell in cells:
        name = f"{cell['preset']} {cell['method']}"
        if settings.setdefault(name, cell["settings"]) != cell["settings"]:
            raise RuntimeError(f"{root} holds cells of {name} with different settings; make them with --again fit")
    kept = [{name: value for name, value in cell.items() if name != "settings"} for cell in cells]
    versions = {"wildsmoke": __version__, "python": platform.python_version(), **{name: version(name) for name in PACKAGES}}
    return {"machine": machine(), "versions": versions, "settings": settings, "cells": kept}


def machine() -> dict[str, Any]:
    """Its processor by name, cores and memory, as far as the system tells."""
    info = Path("/proc/cpuinfo")
    names = [line.partition(":")[2].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1024**3
    return {
        "processor": names[0] if names else platform.machine(),
        "cores": os.cpu_count(),
        "memory_gib": round(memory, 1),
        "system": platform.system(),
    }


def code_digest() -> str:
    """Of the backend's sources: cells with different ones were not made by the same program."""
    digest = hashlib.sha256()
    for path in sorted((CHECKOUT / "backend").rglob("*.py")):
        digest.update(path.relative_to(CHECKOUT).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def without_frames(found: Any) -> Any:
    """The same without the figures of single frames."""
    if not isinstance(found, dict):
        return found
    return {name: without_frames(value) for name, value in found.items() if not name.startswith("by_frame_")}


def as_text(results: dict[str, Any], rows: str = "cells") -> str:
    """JSON with a line for each of its rows, which come last, so that one that changes changes a line."""
    head = ",\n".join(f"{json.dumps(name)}: {json.dumps(value)}" for name, value in results.items() if name != rows)
    lines = ",\n".join(json.dumps(row, allow_nan=False) for row in results[rows])
    return f"{{\n{head},\n{json.dumps(rows)}: [\n{lines}\n]\n}}\n"


def summary(cell: dict[str, Any]) -> dict[str, Any]:
    """The figures that are compared most, for a look while it runs: ours, and the best trivial answer's with its name."""
    scores = cell["scores"]
    row: dict[str, Any] = {name: cell[name] for name in ("preset", "method", "scene", "untouched")}
    row |= {name: cell["cost"][name] for name in ("seconds", "cpu_seconds", "peak_gib", "is_resumed")}
    row["input_smoke_db"] = scores["input"]["ours"]["smoke_db"]
    for view in ("nvs", "side", "back", "future_input", "future_nvs"):
        for figure in ("full_db", "first_db", "middle_db", "last_db") if view == "nvs" else ("full_db",):
            row[f"{view}_{figure}"] = [scores[view]["ours"][figure], *best_trivial(scores[view], figure)]
    row |= {name: scores["volume"].get(name) for name in ("correlation", "relative_l2", "mass_ratio")}
    row["prior_correlation"] = scores.get("prior_volume", {}).get("correlation")
    row |= scores["volume"].get("velocity", {})
    return row | {f"divergence_{name}": value for name, value in scores["divergence"].items()}


if __name__ == "__main__":
    raise SystemExit(main())
