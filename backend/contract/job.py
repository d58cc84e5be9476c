"""The job: what to reconstruct, and every setting of every stage.

One tree of frozen dataclasses. The unit of a field stands in its docstring line; ranges are checked when it is made.
Presets are functions. `--set section.field=value` replaces one field; an unknown key is an error, never ignored.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .errors import BackendError
from .units import JOB_FORMAT_VERSION

PRESETS = ("draft", "preview", "final")
METHODS = ("default", "as_published", "fluidnexus")
DEVICES = ("auto", "cpu", "cuda")
EXTRACTION_MODES = ("auto", "on_black", "alpha", "matte")
CAMERA_MODES = ("auto", "still", "given")
COLOR_MODES = ("auto", "full", "one_hue")


def _check(name: str, value: float, low: float, high: float) -> None:
    if not (isinstance(value, (int, float)) and math.isfinite(value) and low <= value <= high):
        raise ValueError(f"{name} = {value!r} is outside {low:g} to {high:g}")


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name} = {value!r} is none of {', '.join(choices)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class FramesConfig:
    """Decoding.

    working_size: longest side of the frames that are fitted, px; larger ones are reduced in linear light.
    frame_rate: frames per second; 0 takes it from the file (image sequences: 24).
    """

    working_size: int = 192
    frame_rate: float = 0.0

    def __post_init__(self) -> None:
        _check("working_size", self.working_size, 16, 8192)
        _check("frame_rate", self.frame_rate, 0.0, 1000.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtractionConfig:
    """The smoke layer.

    mode: "auto" recognises alpha and smoke on black, else mattes.
    clean_plate / garbage_matte / smoke_mask: optional image paths, "" for none. The plate replaces the estimate;
    black in the garbage matte is never smoke; white in the smoke mask is always kept.
    plate_frames: frames sampled over the clip for the clean plate.
    guided_radius: radius of the edge-aware filter, share of the longest side.
    """

    mode: str = "auto"
    clean_plate: str = ""
    garbage_matte: str = ""
    smoke_mask: str = ""
    plate_frames: int = 48
    guided_radius: float = 0.01

    def __post_init__(self) -> None:
        _check_choice("mode", self.mode, EXTRACTION_MODES)
        _check("plate_frames", self.plate_frames, 3, 1000)
        _check("guided_radius", self.guided_radius, 0.0, 0.2)


@dataclass(frozen=True, slots=True, kw_only=True)
class CamerasConfig:
    """The camera, where none is given.

    mode: "auto" takes cameras.json when there is one, else a camera that stands still.
    field_of_view_deg: of the longer side, degrees. distance_m: from the camera to the smoke, m.
    elevation_deg: how far the camera looks down on the smoke, degrees.
    """

    mode: str = "auto"
    field_of_view_deg: float = 40.0
    distance_m: float = 10.0
    elevation_deg: float = 0.0

    def __post_init__(self) -> None:
        _check_choice("mode", self.mode, CAMERA_MODES)
        _check("field_of_view_deg", self.field_of_view_deg, 0.1, 170.0)
        _check("distance_m", self.distance_m, 1e-4, 1e6)
        _check("elevation_deg", self.elevation_deg, -89.0, 89.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class VolumeConfig:
    """Where in depth the smoke is and how it moves, as a prior trained on simulated smoke proposes it.

    use_prior: ask it, where `method` is "default"; else the images and a solid around the silhouette tell alone.
    as_deep_as_wide: of it count the motion and where in depth smoke lies; how deep it is says its silhouette.
    stride: frames between the images that it compares; 0 finds it from the motion.
    every: frames from one that it is asked about to the next, at most two strides; what lies between is carried along.
    finer: it is asked about parts of the smoke, too, and what becomes of that stands on voxels two thirds as large as its own.
    """

    use_prior: bool = True
    as_deep_as_wide: bool = False
    stride: int = 0
    every: int = 5
    finer: bool = True

    def __post_init__(self) -> None:
        _check("every", self.every, 1, 16)
        _check("stride", self.stride, 0, 60)


@dataclass(frozen=True, slots=True, kw_only=True)
class PhysicalConfig:
    """Position-based fluid: where the smoke moves.

    num_particles: in the frame that shows most smoke. solver_iterations: density projections a substep.
    max_substeps: a frame is split so that no particle crosses more than 0.4 smoothing lengths a substep.
    drag: towards the surrounding air, 1/s. flow_gain: share of the observed image motion taken on a frame, 0 to 1.
    correction_iterations: gradient steps on the image a frame. learn_buoyancy: fit strength and direction.
    """

    num_particles: int = 1500
    solver_iterations: int = 3
    max_substeps: int = 4
    drag: float = 0.5
    flow_gain: float = 0.6
    correction_iterations: int = 4
    learn_buoyancy: bool = True

    def __post_init__(self) -> None:
        _check("num_particles", self.num_particles, 8, 1_000_000)
        _check("solver_iterations", self.solver_iterations, 0, 100)
        _check("max_substeps", self.max_substeps, 1, 64)
        _check("drag", self.drag, 0.0, 1e3)
        _check("flow_gain", self.flow_gain, 0.0, 1.0)
        _check("correction_iterations", self.correction_iterations, 0, 1000)


@dataclass(frozen=True, slots=True, kw_only=True)
class VisualConfig:
    """Gaussians: what the smoke looks like.

    num_particles: none is born where a frame's picture shows as many; more may be beside it, and come back. iterations:
    optimiser steps a frame. mass_iterations: multiplicative updates of the optical masses a frame. consistency: pull
    towards the optical masses carried from the previous frame, 0 to 1. color: "full" fits three channels, "one_hue" only
    how bright the clip's one hue is; "auto" looks at the clip which will do.
    """

    num_particles: int = 6000
    iterations: int = 6
    mass_iterations: int = 1
    consistency: float = 0.1
    color: str = "auto"

    def __post_init__(self) -> None:
        _check_choice("color", self.color, COLOR_MODES)
        _check("num_particles", self.num_particles, 8, 10_000_000)
        _check("iterations", self.iterations, 0, 10_000)
        _check("mass_iterations", self.mass_iterations, 1, 1000)
        _check("consistency", self.consistency, 0.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedConfig:
    """The published methods, where `method` names one; the sections physical and visual then have no say.

    num_physical: physical particles in the frame that shows most smoke. num_particles: as in VisualConfig.
    physical_iterations, visual_iterations: optimiser steps a frame. first_frame_factor: times as many in the first one.
    solver_iterations: density projections a substep. buoyancy: upwards, m/s^2; what is kept, or where learning starts.
    surface_drag: where smoke borders on air, 1/s. viscosity: how fast neighbours' velocities become equal, 1/s.
    warm_up: iterations until the frequency loss has its full weight.
    """

    num_physical: int = 1500
    num_particles: int = 6000
    physical_iterations: int = 12
    visual_iterations: int = 12
    first_frame_factor: int = 5
    solver_iterations: int = 5
    buoyancy: float = 1.0
    surface_drag: float = 3.0
    viscosity: float = 3.0
    warm_up: int = 500

    def __post_init__(self) -> None:
        _check("num_physical", self.num_physical, 8, 1_000_000)
        _check("num_particles", self.num_particles, 8, 10_000_000)
        _check("physical_iterations", self.physical_iterations, 0, 10_000)
        _check("visual_iterations", self.visual_iterations, 0, 10_000)
        _check("first_frame_factor", self.first_frame_factor, 1, 1000)
        _check("solver_iterations", self.solver_iterations, 0, 100)
        _check("buoyancy", self.buoyancy, -1e3, 1e3)
        _check("surface_drag", self.surface_drag, 0.0, 1e3)
        _check("viscosity", self.viscosity, 0.0, 1e3)
        _check("warm_up", self.warm_up, 0, 1_000_000_000)


@dataclass(frozen=True, slots=True, kw_only=True)
class ForecastConfig:
    """The most likely next frames.

    num_frames: 0 for none. fading: how fast trust in the motion is lost to the frozen last frame, e-folds while smoke goes
    as far as it is large; 0 never. spreading: by how much moving smoke widens, standard deviation as a share of its way.
    """

    num_frames: int = 0
    fading: float = 0.3
    spreading: float = 0.1

    def __post_init__(self) -> None:
        _check("num_frames", self.num_frames, 0, 10_000)
        _check("fading", self.fading, 0.0, 100.0)
        _check("spreading", self.spreading, 0.0, 10.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportConfig:
    """The VDB sequence. voxel_size: m, 0 for the size that the particles carry. max_voxels: of the longest side."""

    voxel_size: float = 0.0
    max_voxels: int = 128

    def __post_init__(self) -> None:
        _check("voxel_size", self.voxel_size, 0.0, 1e6)
        _check("max_voxels", self.max_voxels, 8, 2048)


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """Every setting. seed: of all random numbers. method: how physical and visual particles are fitted and forecast.
    follow_clip: let the clip decide what it requires (contract/decisions.py); off, every setting stands as it is."""

    seed: int = 0
    method: str = "default"
    follow_clip: bool = True
    frames: FramesConfig = field(default_factory=FramesConfig)
    extraction: ExtractionConfig = field(default_factory=ExtractionConfig)
    cameras: CamerasConfig = field(default_factory=CamerasConfig)
    volume: VolumeConfig = field(default_factory=VolumeConfig)
    physical: PhysicalConfig = field(default_factory=PhysicalConfig)
    visual: VisualConfig = field(default_factory=VisualConfig)
    published: PublishedConfig = field(default_factory=PublishedConfig)
    forecast: ForecastConfig = field(default_factory=ForecastConfig)
    export: ExportConfig = field(default_factory=ExportConfig)

    def __post_init__(self) -> None:
        _check("seed", self.seed, 0, 2**31 - 1)
        _check_choice("method", self.method, METHODS)


def draft() -> Config:
    """A first look."""
    return Config(
        volume=VolumeConfig(finer=False),
        physical=PhysicalConfig(num_particles=1000, solver_iterations=2, correction_iterations=2),
        visual=VisualConfig(num_particles=4000, iterations=3),
        published=PublishedConfig(num_physical=1000, num_particles=4000, physical_iterations=6, visual_iterations=6),
        export=ExportConfig(max_voxels=96),
    )


def preview() -> Config:
    """What an artist works with."""
    return Config()


def final() -> Config:
    """As good as it gets."""
    return Config(
        frames=FramesConfig(working_size=480),
        physical=PhysicalConfig(num_particles=4000, solver_iterations=4, correction_iterations=8),
        visual=VisualConfig(num_particles=24000, iterations=16),
        published=PublishedConfig(num_physical=4000, num_particles=24000, physical_iterations=30, visual_iterations=30),
        export=ExportConfig(max_voxels=192),
    )


def preset_config(name: str) -> Config:
    """The settings of a preset by name."""
    presets = {"draft": draft, "preview": preview, "final": final}
    if name not in presets:
        raise BackendError("unknown_preset", f'There is no preset "{name}".', hint=f"Choose one of {', '.join(PRESETS)}.")
    return presets[name]()


def settable_keys(config: Config) -> list[str]:
    """Every key that `--set` takes, such as "frames.working_size"."""
    keys = []
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            keys += [f"{item.name}.{inner.name}" for inner in dataclasses.fields(value)]
        else:
            keys.append(item.name)
    return keys


def override(config: Config, overrides: Mapping[str, Any]) -> Config:
    """A config with single fields replaced. Values may be strings, as on the command line."""
    for key, raw in overrides.items():
        if key not in settable_keys(config):
            raise BackendError(
                "unknown_setting",
                f'There is no setting "{key}".',
                hint=f"Settings are: {', '.join(settable_keys(config))}.",
            )
        section_name, _, field_name = key.rpartition(".")
        section = getattr(config, section_name) if section_name else config
        try:
            value = _converted(raw, getattr(section, field_name))
            changed = dataclasses.replace(section, **{field_name: value})
        except (ValueError, TypeError) as error:
            raise BackendError("bad_setting", f"Setting {key}: {error}.", hint="Give a value inside the range.") from error
        config = dataclasses.replace(config, **{section_name: changed}) if section_name else changed
    return config


def _converted(raw: Any, current: Any) -> Any:
    """`raw` in the type of `current`. Raises ValueError where it does not fit."""
    if isinstance(current, bool):
        words = {"true": True, "1": True, "yes": True, "on": True, "false": False, "0": False, "no": False, "off": False}
        if isinstance(raw, bool):
            return raw
        if str(raw).lower() in words:
            return words[str(raw).lower()]
        raise ValueError(f"{raw!r} is neither true nor false")
    if isinstance(raw, bool):
        raise ValueError(f"{raw!r} is not a number or text")
    if isinstance(current, int):
        if isinstance(raw, float) and not raw.is_integer():
            raise ValueError(f"{raw!r} is not a whole number")
        return int(raw)
    if isinstance(current, float):
        return float(raw)
    return str(raw)


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One reconstruction, as job.json holds it.

    video: file, folder of images, or a pattern such as shot_%04d.png. frame_start, frame_stop: frames A to B-1 are
    fitted, None for the clip's own ends. cameras: path of a cameras.json, or None. overrides: as given to `--set`.
    """

    video: str
    preset: str = "preview"
    cameras: str | None = None
    frame_start: int | None = None
    frame_stop: int | None = None
    device: str = "auto"
    overrides: dict[str, Any] = field(default_factory=dict)

    def config(self) -> Config:
        """The settings: the preset with the overrides applied. Raises BackendError."""
        return override(preset_config(self.preset), self.overrides)

    def to_json(self) -> str:
        """The text of job.json."""
        return json.dumps(
            {"format_version": JOB_FORMAT_VERSION, **dataclasses.asdict(self)}, indent=2, sort_keys=True, allow_nan=False
        )


_JOB_TYPES: dict[str, tuple[type, ...]] = {
    "video": (str,),
    "preset": (str,),
    "cameras": (str, type(None)),
    "frame_start": (int, type(None)),
    "frame_stop": (int, type(None)),
    "device": (str,),
    "overrides": (dict,),
}


def read_job(path: str | os.PathLike[str]) -> Job:
    """The job in a job.json, checked. Raises BackendError."""
    hint = "Write the job again with `reconstruct` or with the panel."
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise BackendError("job_missing", f"There is no job at {path}.", hint="Give the folder of a job.") from error
    except (OSError, ValueError, RecursionError) as error:
        raise BackendError("job_unreadable", f"{path} cannot be read: {error}.", hint=hint) from error
    if not isinstance(data, dict):
        raise BackendError("job_unreadable", f"{path} holds no job.", hint=hint)
    version = data.pop("format_version", None)
    if version != JOB_FORMAT_VERSION:
        raise BackendError("job_version", f"{path} has format version {version!r}; this is {JOB_FORMAT_VERSION}.", hint=hint)
    unknown = set(data) - set(_JOB_TYPES)
    if unknown or "video" not in data:
        problem = f"unknown entry {sorted(unknown)[0]!r}" if unknown else "no video"
        raise BackendError("job_unreadable", f"{path}: {problem}.", hint=hint)
    for name, value in data.items():
        if not isinstance(value, _JOB_TYPES[name]) or isinstance(value, bool):
            raise BackendError("job_unreadable", f"{path}: {name} has the wrong type.", hint=hint)
    return checked_job(Job(**data))


def checked_job(job: Job) -> Job:
    """The job itself, if its parts fit together. Raises BackendError."""
    if job.device not in DEVICES:
        raise BackendError("unknown_device", f'There is no device "{job.device}".', hint=f"Choose one of {', '.join(DEVICES)}.")
    start, stop = job.frame_start, job.frame_stop
    if (start is not None and start < 0) or (stop is not None and stop <= (start or 0)):
        raise BackendError("bad_frame_range", f"The frame range {start}:{stop} is empty.", hint="Give A:B with 0 <= A < B.")
    job.config()
    return job
