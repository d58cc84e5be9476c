"""What the report shows of volumes: sums along the axes, a slice, the upward velocity in it, and the figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from backend.score.page import markup, pictures
from backend.score.truth_set import Truth, Volume
from backend.score.volumes import Volumes

_FIGURES = {  # figure -> words, digits
    "correlation": ("density correlation, 1 is the truth", 3),
    "relative_l2": ("relative L2 error of the density, 0 is the truth", 3),
    "mass_ratio": ("optical mass over the true one, 1 is the truth", 3),
    "correlation_sideways": ("velocity correlation, sideways in the image", 3),
    "correlation_up": ("velocity correlation, upwards", 3),
    "correlation_depth": ("velocity correlation, in depth", 3),
    "end_point_error": ("velocity end-point error, m/s", 3),
    "still_error": ("the same of smoke that stands still, m/s", 3),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Moment:
    """Densities [X, Y, Z] 1/m and velocities [X, Y, Z, 3] m/s of one frame, by who says so; the truth is the first."""

    frame: int
    real: Volume
    density: dict[str, np.ndarray]
    velocity: dict[str, np.ndarray]


def figures(scores: Mapping[str, Any]) -> str:
    """A table; empty without true volumes."""
    columns = {"ours": scores["volume"], "volumes followed": scores.get("prior_volume", {})}
    columns = {name: found | found.get("velocity", {}) for name, found in columns.items() if found}
    if not columns:
        return ""
    rows = [
        [words, *(markup.number(found.get(figure), digits) for found in columns.values())]
        for figure, (words, digits) in _FIGURES.items()
        if any(figure in found for found in columns.values())
    ]
    caption = "Means over the seen moments with true volumes; velocities inside true smoke"
    return markup.table(["figure", *map(escape, columns)], rows, caption=caption)


def shown(prediction: Volumes, prior: Volumes | None, truth: Truth) -> str:
    """Pictures of one moment; empty without true volumes."""
    moment = _moment(prediction, prior, truth)
    if moment is None:
        return ""
    size = moment.real.voxel_size
    parts = []
    for axis, words in ((1, "sum along y"), (0, "sum along x"), (2, "sum along z, from above")):
        planes = {name: pictures.upright(size * found.sum(axis=axis)) for name, found in moment.density.items()}
        parts.append(_density_row(planes, f"Frame {moment.frame}: optical depth, {words}", ""))
    weight = moment.real.density.sum(axis=(0, 2), dtype=np.float64)
    middle = round(float((weight * np.arange(len(weight))).sum() / weight.sum()))
    planes = {name: pictures.upright(found[:, middle]) for name, found in moment.density.items()}
    parts.append(
        _density_row(planes, f"Frame {moment.frame}: extinction in the upright plane through the middle of the smoke", " /m")
    )
    if moment.velocity:
        inside = pictures.upright(moment.real.density[:, middle] > 0.01 * moment.real.density.max())
        parts.append(
            _velocity_row({name: pictures.upright(found[:, middle, :, 2]) for name, found in moment.velocity.items()}, inside)
        )
    kind = "moments tall" if moment.real.density.shape[2] > max(moment.real.density.shape[:2]) else "moments"
    return f'<div class="{kind}">{"".join(parts)}</div>'


def _moment(prediction: Volumes, prior: Volumes | None, truth: Truth) -> _Moment | None:
    """The middle one of the seen volumes, preferably with a velocity."""
    frames = [frame for frame in truth.volume_frames() if 0 < frame < truth.num_seen]
    volumes = {frame: truth.volume(frame) for frame in frames}
    found = [frame for frame in frames if volumes[frame].density.max() > 0.0]
    found = [frame for frame in found if volumes[frame].velocity is not None] or found
    if not found:
        return None
    frame = found[len(found) // 2]
    real = volumes[frame]
    density, velocity = {"truth": real.density}, {}
    if real.velocity is not None:
        velocity["truth"] = real.velocity
    for name, who in (("ours", prediction), ("prior", prior)):
        if who is not None:
            density[name], moves = who.volume(real, frame)
            if real.velocity is not None:
                velocity[name] = moves
    return _Moment(frame=frame, real=real, density=density, velocity=velocity)


def _density_row(planes: Mapping[str, np.ndarray], caption: str, unit: str) -> str:
    full = float(np.percentile(planes["truth"], 99.8)) or 1.0
    row = [(name, pictures.grey(plane, full=full)) for name, plane in planes.items()]
    row.insert(2, ("ours less truth", pictures.signed(planes["ours"] - planes["truth"], full=0.5 * full)))
    tiles = [(pictures.inline(picture, is_smooth=False), f"{caption}: {name}", name) for name, picture in row]
    return markup.tiles(tiles, caption=f"{caption}. White: {full:.2g}{unit}; a difference in full colour: half of it.")


def _velocity_row(planes: Mapping[str, np.ndarray], inside: np.ndarray) -> str:
    full = float(np.percentile(np.abs(planes["truth"][inside]), 98)) if inside.any() else 1.0
    told = "upward velocity in the same plane, inside the true smoke"
    tiles = [
        (pictures.inline(pictures.signed(plane * inside, full=full), is_smooth=False), f"{told}: {name}", name)
        for name, plane in planes.items()
    ]
    return markup.tiles(tiles, caption=f"The {told}. Orange rises, blue sinks; full colour: {full:.2g} m/s.")
