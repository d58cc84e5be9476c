"""What `bench` measures: which settings, of which presets, on which frames of which scenes, in which order.

A trial is a set of settings; a cell is a trial on a scene. Around `preview` one setting is changed at a time. Those of the
position-based fluid are changed where no prior leads it, because a fluid that is led does not ask for them. Around `draft`
and `final` stand their neighbours, and a few settings together, so that a preset that something else beats is found out.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from backend.contract.job import PRESETS, preset_config

FRAMES = (75, 105)  # of 120: the camera has turned by 33 to 46 degrees, every scene shows smoke
AHEAD = 9  # frames of the forecast
SEEDS = (0, 1)
NO_PRIOR = ("volume.use_prior", "false")
FOLLOWING = {"follow_clip": "true"}  # elsewhere the settings stand as they are: they are what is measured


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """Settings: a preset with changes. frames: first and stop of the clip; scored_from: the first that is scored.
    repeat: 0, or the number of a run that takes nothing over from others, because it cannot or its own seconds count."""

    preset: str
    changes: tuple[tuple[str, str], ...] = ()
    seed: int = 0
    frames: tuple[int, int] = FRAMES
    scored_from: int = FRAMES[0]
    threads: int = 1
    repeat: int = 0

    @property
    def name(self) -> str:
        """Tells it from all others of the same part of a clip, and does for the name of a file."""
        parts = [self.preset, *(f"{key}={value}" for key, value in self.changes)]
        if self.seed:
            parts.append(f"seed={self.seed}")
        if self.repeat or self.scored_from != self.frames[0]:
            parts.append(f"frames={self.frames[0]}-{self.frames[1]},{self.scored_from}")
        if self.threads != 1:
            parts.append(f"threads={self.threads}")
        return " ".join(parts)

    @property
    def donor(self) -> Trial | None:
        """The trial whose finished stages this one may take over, as far as their settings are the same."""
        if self.repeat:
            return None
        kept = tuple(change for change in self.changes if change == NO_PRIOR)
        base = Trial(preset=self.preset, changes=kept, frames=self.frames, scored_from=self.frames[0])
        return None if base == self else base


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """One setting at several values. stage: the one whose cost it drives; "" for all. points: value and trial, in order.
    is_exponent: whether the values are sizes that a power of can be fitted to."""

    key: str
    base: str
    stage: str
    points: tuple[tuple[str, Trial], ...]
    is_exponent: bool = True


_AROUND_PREVIEW = (  # setting, stage, values; that of the preset is added
    ("visual.iterations", "visual", ("0", "3", "12", "24")),
    ("visual.num_particles", "visual", ("1500", "12000", "24000")),
    ("frames.working_size", "", ("128", "256", "320")),
    ("visual.mass_iterations", "visual", ("2", "4", "8")),
    ("volume.use_prior", "volume", ("false",)),
    ("volume.stride", "volume", ("1", "3", "12")),
    ("volume.every", "volume", ("1", "6")),
    ("volume.finer", "volume", ("false",)),
    ("export.max_voxels", "export", ("64", "96", "256")),
    ("physical.num_particles", "physical", ("400", "6000")),
    ("visual.color", "visual", ("one_hue",)),
)
_WITHOUT_PRIOR = (
    ("physical.num_particles", "physical", ("400", "6000")),
    ("physical.solver_iterations", "physical", ("1", "12")),
    ("physical.correction_iterations", "physical", ("0", "16")),
)
_TOGETHER = {
    "draft": (
        {"visual.iterations": "1"},
        {"visual.num_particles": "1500"},
        {"visual.mass_iterations": "2"},
        {"export.max_voxels": "64"},
        {"volume.use_prior": "false"},
        {"volume.finer": "true"},
        {"visual.iterations": "6", "visual.num_particles": "1500"},
        {"frames.working_size": "128", "visual.num_particles": "3000"},
        FOLLOWING,
    ),
    "preview": (
        {"visual.num_particles": "12000", "visual.iterations": "3"},
        {"frames.working_size": "128", "export.max_voxels": "64"},
        {"visual.num_particles": "4000"},
        FOLLOWING,
    ),
    "final": (
        {"visual.iterations": "8"},
        {"visual.num_particles": "12000"},
        {"visual.mass_iterations": "2"},
        {"visual.mass_iterations": "12"},
        {"volume.every": "1"},
        {"volume.finer": "false"},
        {"export.max_voxels": "128"},
        {"export.max_voxels": "256"},
        {"frames.working_size": "256"},
        FOLLOWING,
    ),
}


def sweeps(*, threads: int, frames: tuple[int, int] = FRAMES) -> list[Sweep]:
    """threads: as many as there are processors to run on."""
    found = [_sweep((), key, stage, values, frames) for key, stage, values in _AROUND_PREVIEW]
    found += [_sweep((NO_PRIOR,), key, stage, values, frames) for key, stage, values in _WITHOUT_PRIOR]
    last = frames[1] - (frames[1] - frames[0]) // 2  # lengths are scored on the frames that all of them hold
    starts = [start for start in (last, frames[0], 2 * frames[0] - frames[1]) if start >= 0]
    lengths = [
        Trial(preset="preview", frames=(start, frames[1]), scored_from=last, repeat=int(start != frames[0])) for start in starts
    ]
    points = tuple((f"{trial.frames[1] - trial.frames[0]}", trial) for trial in lengths)
    found.append(Sweep(key="number of frames", base="preview", stage="", points=points))
    if threads > 1:
        counts = [count for count in (1, 2, 4, 8, 16, 32) if count < threads] + [threads]
        alone = [Trial(preset="preview", frames=frames, scored_from=frames[0], threads=count, repeat=1) for count in counts]
        points = tuple((f"{trial.threads}", trial) for trial in alone)
        found.append(Sweep(key="threads", base="preview", stage="", points=points))
    return found


def compared(*, frames: tuple[int, int] = FRAMES) -> list[Trial]:
    """The presets; then of each, the cheapest first, what stands near it, and itself with other random numbers."""
    bases = {preset: Trial(preset=preset, frames=frames, scored_from=frames[0]) for preset in PRESETS}
    found = list(bases.values())
    for preset, base in bases.items():
        found += [replace(base, changes=tuple(together.items())) for together in _TOGETHER[preset]]
        found += [replace(base, seed=seed) for seed in SEEDS[1:]]
    return found


def with_donors(trials: Iterable[Trial]) -> list[Trial]:
    """Each once, behind the one that it takes from."""
    return list(dict.fromkeys(found for trial in trials for found in (trial.donor, trial) if found is not None))


def _sweep(shared: tuple[tuple[str, str], ...], key: str, stage: str, values: tuple[str, ...], frames: tuple[int, int]) -> Sweep:
    """shared: what all points have besides. The preset's own value is among them."""
    middle = str(_value("preview", key)).lower()
    base = Trial(preset="preview", changes=shared, frames=frames, scored_from=frames[0])
    others = [value for value in values if value != middle]
    points = [(middle, base), *((value, replace(base, changes=(*shared, (key, value)))) for value in others)]
    is_exponent = all(value.isdigit() for value, _ in points) and middle != "0"
    if is_exponent:
        points.sort(key=lambda point: int(point[0]))
    return Sweep(key=key, base=base.name, stage=stage, points=tuple(points), is_exponent=is_exponent)


def _value(preset: str, key: str) -> object:
    found: object = preset_config(preset)
    for name in key.split("."):
        found = getattr(found, name)
    return found
