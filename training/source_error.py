"""How far from a source the smoke is taken to rise, for plumes of a library: by its foot alone, and as a fit takes it.

    .venv/backend/bin/python -m training.source_error --plumes DIR --json FILE

Each plume is filmed once: from a random side and height, by a camera that goes around it by 0.15 to 0.7 degrees a frame, for 40
to 120 frames. The source is looked for in all of it, in its halves, and in its first and last quarter. Errors are level with the
ground, from the nearest source that burned meanwhile.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from backend.fit.foot import foot_point
from backend.fit.scene import turned_about
from backend.fit.source import source_point
from backend.geometry.camera import View, view_at
from backend.io.atomic import write_text
from synthetic.progress import Progress
from synthetic.sweep import Orbit, orbit_cameras
from training.judge import opacity_of
from training.library import FPS, NUM_FRAMES, Plume, read_plume
from training.samples import filmed

_SIZE = 90, 160  # px
_LENGTHS = 40, 80, 120  # frames of a clip
_SHOWN = 40  # frames that are drawn of it
_NOISE = 0.002
_SMOKE = 0.1  # optical depth; clips that show less are left out
_PARTS = {
    "whole": (0.0, 1.0),
    "first half": (0.0, 0.5),
    "second half": (0.5, 1.0),
    "first quarter": (0.0, 0.25),
    "last quarter": (0.75, 1.0),
}
_HARDLY, _LITTLE = 8.0, 20.0  # degrees that the camera goes around
_WINDY = 0.8  # m/s, and more


def source_errors(plume: Plume) -> dict[str, dict[str, float]]:
    """Of each part of the clip metres, by either way, and what tells clips apart; parts in which nothing burns or shows are left
    out."""
    draw = np.random.default_rng(plume.scene.seed)
    count = int(draw.choice(_LENGTHS))
    first = int(draw.integers(0, NUM_FRAMES - count + 1))
    frames = np.unique(np.linspace(first, first + count - 1, _SHOWN).round().astype(int))
    views = _views(draw, frames)
    depths = [
        filmed(-np.log1p(-np.clip(opacity_of(plume, int(frame), view), 0.0, 0.99)), _NOISE, draw)
        for frame, view in zip(frames, views, strict=True)
    ]
    found = {}
    for name, (start, stop) in _PARTS.items():
        part = slice(round(start * len(frames)), round(stop * len(frames)))
        row = _errors(plume, frames[part], views[part], depths[part])
        if row is not None:
            found[name] = row
    return found


def _errors(plume: Plume, frames: np.ndarray, views: list[View], depths: list[np.ndarray]) -> dict[str, float] | None:
    seconds = frames[[0, -1]] / FPS
    sources = [item.position for item in plume.scene.sources if item.start < seconds[1] and item.stop > seconds[0]]
    if not sources or max(float(depth.max()) for depth in depths) < _SMOKE:
        return None
    found = {"foot": foot_point(depths.__getitem__, views), "source": source_point(depths.__getitem__, views)}
    off = {name: float(np.linalg.norm((np.array(sources) - point)[:, :2], axis=1).min()) for name, point in found.items()}
    told = {
        "sources": len(sources),
        "wind": float(np.hypot(*plume.scene.wind)),
        "turned": math.degrees(turned_about(views, found["source"])),
        **off,
    }
    return {name: round(value, 3) for name, value in told.items()}


def _views(draw: np.random.Generator, frames: np.ndarray) -> list[View]:
    """Of some frames of a random camera."""
    start, rate = draw.uniform(-180, 180), draw.choice([-1, 1]) * draw.uniform(0.15, 0.7)
    orbit = replace(Orbit(), azimuth_start=start, azimuth_stop=start + rate * NUM_FRAMES, elevation=float(draw.uniform(2, 20)))
    cameras = orbit_cameras(orbit, width=_SIZE[0], height=_SIZE[1], fps=FPS, num_frames=NUM_FRAMES)
    return [view_at(cameras, int(frame)) for frame in frames]


def summary(rows: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Of kinds of clips: how many, means and medians of the errors, and how often they are more than a metre."""
    kinds = {
        "all": rows,
        "windy": [row for row in rows if row["wind"] >= _WINDY],
        "calm": [row for row in rows if row["wind"] < _WINDY],
        "one source": [row for row in rows if row["sources"] == 1],
        "more": [row for row in rows if row["sources"] > 1],
    }
    found = {}
    for kind, some in kinds.items():
        line: dict[str, float] = {"clips": len(some)}
        for name in ("foot", "source") if some else ():
            errors = np.array([row[name] for row in some])
            line |= {
                f"{name}, mean": round(float(errors.mean()), 3),
                f"{name}, median": round(float(np.median(errors)), 3),
                f"{name}, beyond 1 m": round(float((errors > 1).mean()), 3),
            }
        found[kind] = line
    return found


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plumes", type=Path, required=True)
    parser.add_argument("--json", type=Path, required=True)
    given = parser.parse_args(arguments)
    folders = sorted(path.parent for path in given.plumes.glob("*/plume.json"))
    found, progress = {}, Progress(label="find sources", total=len(folders))
    for folder in folders:
        found[folder.name] = source_errors(read_plume(folder))
        progress.step()
    rows = [row for parts in found.values() for row in parts.values()]
    groups = {
        "whole clips": [parts["whole"] for parts in found.values() if "whole" in parts],
        "all parts": rows,
        "parts, camera goes less than 8 degrees around": [row for row in rows if row["turned"] < _HARDLY],
        "parts, camera goes less than 20 degrees around": [row for row in rows if row["turned"] < _LITTLE],
        "parts, camera goes further": [row for row in rows if row["turned"] >= _LITTLE],
    }
    told = {name: summary(some) for name, some in groups.items()}
    lines = ",\n".join(f" {json.dumps(name)}: {json.dumps(parts)}" for name, parts in found.items())
    write_text(given.json, f'{{"summary": {json.dumps(told, indent=1)},\n"plumes": {{\n{lines}\n}}}}\n')
    print(json.dumps(told, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
