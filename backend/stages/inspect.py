"""What a clip needs, and why: every decision with the quantity that was measured for it. Nothing is fitted."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from backend.contract.job import Config, FramesConfig
from backend.fit import stabilise
from backend.fit.extraction import SmokeLayer, extract
from backend.io.video import Clip
from backend.io.working_frames import has_premultiplied_alpha, reduced, working_size
from backend.reporting import SilentReport

_MAX_FRAMES = 48  # looked at, spread over the part that is decoded
_MAX_DECODED = 900  # frames; the end of a longer clip is not looked at
_MAX_SIDE = 320  # px
_SMOKE_OPACITY = 0.05
_DENSE_OPACITY, _DENSE_SHARE = 0.8, 0.2  # dense: this share of the smoke's pixels is more opaque than this
_COLORED = 0.15  # (largest - smallest channel) / largest, of the mean smoke colour
_EVOLVING = 0.2  # share of the opacity that is elsewhere, or gone, between the clip's first and last third
_PIXELS_A_PARTICLE = 2.0  # finer than this, the picture cannot tell visual particles apart


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """One choice: its name, the value chosen, why in one sentence, and the measured quantities behind it."""

    name: str
    value: str | int
    reason: str
    measured: dict[str, float] = field(default_factory=dict)


def inspect(clip: Clip, config: Config) -> list[Decision]:
    """The decisions for a clip, from at most 48 of its frames at 320 px. Raises BackendError, as a run would."""
    frames = _sampled(clip, config.frames)
    report = SilentReport()
    layer = extract(frames, config.extraction, report, has_alpha=clip.has_alpha)
    layers = list(layer.frames)
    opacities = np.stack([image[..., 3] for image in layers])
    return [
        Decision(name="extraction", value=layer.mode, reason=layer.reason, measured=layer.measured),
        _camera(frames, layers, config),
        _density(opacities),
        _color(layers, layer),
        _change(opacities),
        _resolution(clip, config),
        _particles(clip, config, opacities),
    ]


def to_text(decisions: Sequence[Decision]) -> str:
    """For people: one decision a paragraph."""
    width = max(len(decision.name) for decision in decisions)
    lines = []
    for decision in decisions:
        lines.append(f"{decision.name:<{width}}  {decision.value}: {decision.reason}")
        if decision.measured:
            figures = ", ".join(f"{name} {value:.4g}" for name, value in decision.measured.items())
            lines.append(f"{'':<{width}}  ({figures})")
    return "\n".join(lines)


def to_json(decisions: Sequence[Decision]) -> str:
    """For programs: {"decisions": [{"name", "value", "reason", "measured"}]}."""
    return json.dumps({"decisions": [dataclasses.asdict(d) for d in decisions]}, indent=2, allow_nan=False)


def _sampled(clip: Clip, config: FramesConfig) -> list[np.ndarray]:
    """At most 48 frames [h, w, 4] linear, evenly spread."""
    small = dataclasses.replace(config, working_size=min(config.working_size, _MAX_SIDE))
    size = working_size(clip, small)
    num = min(clip.num_frames, _MAX_DECODED)
    wanted = set(np.unique(np.linspace(0, num - 1, min(num, _MAX_FRAMES)).round().astype(int)).tolist())
    is_premultiplied = clip.has_alpha and has_premultiplied_alpha(clip.frames(0, num))
    return [
        reduced(image, size, is_premultiplied=is_premultiplied)
        for index, image in enumerate(clip.frames(0, max(wanted) + 1))
        if index in wanted
    ]


def _camera(frames: list[np.ndarray], layers: list[np.ndarray], config: Config) -> Decision:
    name = "camera"
    if config.cameras.mode != "auto":
        return Decision(name=name, value=config.cameras.mode, reason="The settings say so.")
    motion = stabilise.measure_motion(frames, range(len(frames)), background=lambda k: stabilise.is_background(layers[k]))
    measured = {"tracks": float(motion.num_tracks), "displacement": motion.displacement, "parallax": motion.parallax}
    if not motion.is_known:
        reason = "The background shows nothing that could be tracked, so nothing says that the camera moves."
        return Decision(name=name, value="still", reason=reason, measured=measured)
    if motion.is_still:
        reason = f"The background shifts by {motion.displacement:.2%} of the picture."
        return Decision(name=name, value="still", reason=reason, measured=measured)
    reason = f"The background shifts by {motion.displacement:.0%} of the picture; give cameras.json, else it is taken as still."
    return Decision(name=name, value="moving", reason=reason, measured=measured)


def _density(opacities: np.ndarray) -> Decision:
    """opacities [n, h, w]."""
    smoke = opacities[opacities > _SMOKE_OPACITY]
    share = float(np.mean(smoke > _DENSE_OPACITY)) if smoke.size else 0.0
    is_dense = share > _DENSE_SHARE
    reason = f"{share:.0%} of the smoke's pixels are more than {_DENSE_OPACITY:.0%} opaque."
    measured = {"opaque_share": share, "median_opacity": float(np.median(smoke)) if smoke.size else 0.0}
    return Decision(name="density", value="dense" if is_dense else "light", reason=reason, measured=measured)


def _color(layers: list[np.ndarray], layer: SmokeLayer) -> Decision:
    light = np.sum([image[..., :3].sum(axis=(0, 1), dtype=np.float64) for image in layers], axis=0)
    mass = sum(float(image[..., 3].sum(dtype=np.float64)) for image in layers)
    color = light / max(mass, 1e-9)
    chroma = float((color.max() - color.min()) / max(color.max(), 1e-6))
    is_colored = chroma > _COLORED
    reason = f"The channels of the mean smoke colour differ by {chroma:.0%}."
    measured = {"chroma": chroma, "red": float(color[0]), "green": float(color[1]), "blue": float(color[2])}
    return Decision(name="color", value="coloured" if is_colored else "grey", reason=reason, measured=measured)


def _change(opacities: np.ndarray) -> Decision:
    """Whether the smoke as a whole stays as it is: mean opacity of the first third against that of the last."""
    third = max(1, len(opacities) // 3)
    first, last = opacities[:third].mean(axis=0), opacities[-third:].mean(axis=0)
    distance = float(np.abs(last - first).sum() / max(first.sum() + last.sum(), 1e-6))
    growth = float(last.sum() / max(first.sum(), 1e-6))
    value = "evolving" if distance > _EVOLVING else "quasi-steady"
    reason = f"Between its first and its last third, {distance:.0%} of the clip's smoke is in another place, new or gone."
    return Decision(name="change", value=value, reason=reason, measured={"distance": distance, "growth": growth})


def _resolution(clip: Clip, config: Config) -> Decision:
    width, height = working_size(clip, config.frames)
    is_reduced = (width, height) != (clip.width, clip.height)
    reason = f"The clip is {clip.width} x {clip.height}; the longest side is held to {config.frames.working_size} px."
    if not is_reduced:
        reason = f"The clip is {clip.width} x {clip.height}, no larger than frames.working_size; it is fitted as it is."
    measured = {"width": float(width), "height": float(height)}
    return Decision(name="resolution", value=f"{width} x {height}", reason=reason, measured=measured)


def _particles(clip: Clip, config: Config, opacities: np.ndarray) -> Decision:
    """The settings' number of visual particles, or fewer where the smoke covers fewer pixels than they could show."""
    width, height = working_size(clip, config.frames)
    covered = float((opacities > _SMOKE_OPACITY).mean()) * width * height
    useful = max(64, round(covered / _PIXELS_A_PARTICLE))
    value = min(config.visual.num_particles, useful)
    reason = f"The smoke covers {covered:.0f} pixels a frame; the settings allow {config.visual.num_particles}."
    return Decision(name="visual particles", value=value, reason=reason, measured={"smoke_pixels": covered})
