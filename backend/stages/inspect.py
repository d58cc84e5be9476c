"""Clip -> decisions: which parts run and at what size, each with its reason and the measured quantity behind it.

Each decision gives settings values that the user left to the clip. Nothing is fitted. What each one saves and costs is in
docs/decisions.md; thresholds were chosen on the tuning scenes named there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, replace
from typing import Any

from backend.contract.cameras import Cameras
from backend.contract.decisions import Decision, Decisions, Warned
from backend.contract.job import Config, FramesConfig, override
from backend.fit.scene import LEAST_TURN
from backend.fit.survey import Survey, decibels, survey
from backend.io.video import Clip
from backend.reporting import Report

LEAST_ONE_HUE_DB = 64.0  # of pictures brought to one hue: 16 dB beyond what the finest fit reaches costs it 0.1 dB
LEAST_DETAIL_DB = 64.0  # of pictures reduced and brought back, likewise
PARTICLES_A_PIXEL = 6.0  # of the frame with most smoke; up to here more particles show more
FEWEST_PARTICLES = 64
KEYS = (  # with which the user decides instead
    "extraction.mode",
    "cameras.mode",
    "frames.working_size",
    "volume.as_deep_as_wide",
    "visual.color",
    "visual.num_particles",
)


def run(
    clip: Clip,
    config: Config,
    report: Report,
    *,
    chosen: Collection[str] = (),  # keys of the settings that the user set
    start: int = 0,
    stop: int | None = None,
    given: Cameras | None = None,
) -> tuple[Decisions, Survey]:
    """The decisions for frames start to stop - 1, and what was measured. Raises BackendError, as a run would."""
    seen = survey(clip, config, report, start=start, stop=clip.num_frames if stop is None else stop, given=given)
    return decide(seen, config, chosen=chosen), seen


def settings_of(config: Config) -> dict[str, Any]:
    """The settings that decisions follow from: with others changed they stay."""
    sections = {"frames", "extraction", "cameras", "volume", "visual"}
    return {name: value for name, value in asdict(config).items() if name in sections | {"method", "follow_clip"}}


def decide(seen: Survey, config: Config, *, chosen: Collection[str] = ()) -> Decisions:
    """What follows from a survey. With follow_clip off, or set by the user, a setting stands as it is."""
    makers: list[Callable[[Survey, Config], Decision]] = [_extraction, _camera, _resolution]
    if config.method == "default":
        makers += [_depth, _color, _particles]
    made: list[Decision] = []
    followed = config
    for make in makers:
        made.append(_overruled(make(seen, followed), config, chosen))
        followed = override(followed, made[-1].sets)  # how many particles show depends on the resolution
    return Decisions(decisions=tuple(made), warnings=_warnings(made))


def _overruled(decision: Decision, config: Config, chosen: Collection[str]) -> Decision:
    """The decision, or the user's own where there is one."""
    by_user = [key for key in decision.keys if key in chosen and _value(config, key) != "auto"]
    if by_user:
        reason = f"You set {by_user[0]}. {decision.reason}"
    elif not config.follow_clip:
        reason = f"follow_clip is off, so the settings stand. {decision.reason}"
    else:
        return decision
    stands = _value(config, decision.keys[0])
    value = decision.value if stands == "auto" else _word(decision.name, stands)
    return replace(decision, value=value, reason=reason, sets={}, is_overridden=True)


def _word(name: str, value: object) -> str | int:
    """A setting's value as its decision would call it."""
    if isinstance(value, bool):
        return "silhouette" if value else "prior"
    if name == "resolution":
        return f"at most {value} px"
    return value if isinstance(value, (str, int)) else str(value)


def _value(config: Config, key: str) -> object:
    section, _, name = key.rpartition(".")
    return getattr(getattr(config, section) if section else config, name)


def _extraction(seen: Survey, config: Config) -> Decision:
    return Decision(
        name="extraction",
        value=seen.mode,
        reason=seen.mode_reason,
        measured=seen.measured,
        sets={"extraction.mode": seen.mode},
        keys=("extraction.mode",),
    )


def _camera(seen: Survey, config: Config) -> Decision:
    motion, measured = seen.motion, {}
    if seen.has_cameras:
        value, measured = "given", {"turn_degrees": math.degrees(seen.turn)}
        reason = f"cameras.json says where it is; it goes {math.degrees(seen.turn):.0f} degrees around the smoke."
    elif motion is None:
        value, reason = "still", "The clip shows no background against which a camera could be seen to move."
    else:
        measured = {"tracks": float(motion.num_tracks), "displacement": motion.displacement, "parallax": motion.parallax}
        value = "still"
        if not motion.is_known:
            reason = "The background shows nothing that could be tracked, so nothing says that the camera moves."
        elif motion.is_still:
            reason = f"The background shifts by {motion.displacement:.2%} of the picture."
        else:
            value = "moving"
            reason = f"The background shifts by {motion.displacement:.0%} of the picture; it needs a cameras.json."
    mode = "given" if value == "given" else "still"
    return Decision(
        name="camera", value=value, reason=reason, measured=measured, sets={"cameras.mode": mode}, keys=("cameras.mode",)
    )


def _resolution(seen: Survey, config: Config) -> Decision:
    """The smallest size that still shows what the smoke shows, at most the settings'."""
    longest, wanted = max(seen.source_size), config.frames.working_size
    looked_at, size = max(seen.size), min(wanted, longest)
    enough = [share for share, error in seen.detail_errors.items() if decibels(error) >= LEAST_DETAIL_DB]
    detail = round(min(enough) * looked_at) if enough else None
    measured = {f"kept_at_{round(share * looked_at)}_px_db": decibels(error) for share, error in seen.detail_errors.items()}
    if detail is not None and detail < size:
        size = max(detail, 16)
        reason = f"The smoke has no detail that {size} px do not show ({LEAST_DETAIL_DB:.0f} dB and more)."
    elif size < longest:
        reason = f"The longest side is held to {wanted} px; the smoke has detail enough for them."
    else:
        reason = f"The clip has no more than {longest} px."
    width, height = _scaled(seen.source_size, size)
    return Decision(
        name="resolution",
        value=f"{width} x {height}",
        reason=reason,
        measured=measured,
        sets={} if size >= min(wanted, longest) else {"frames.working_size": size},
        keys=("frames.working_size",),
    )


def _depth(seen: Survey, config: Config) -> Decision:
    degrees, least = math.degrees(seen.turn), math.degrees(LEAST_TURN)
    shows = seen.turn >= LEAST_TURN
    reason = f"The camera goes {degrees:.1f} degrees around the smoke; "
    if not config.volume.use_prior:
        reason = "volume.use_prior is off, so images and silhouette tell alone."
    elif shows:
        reason += f"from {least:.0f} on, the prior sees depth and motion."
    else:
        reason += f"less than {least:.0f} show no depth: the prior sees motion, and smoke is as deep as it is wide."
    return Decision(
        name="depth",
        value="prior" if shows and config.volume.use_prior else "silhouette",
        reason=reason,
        measured={"turn_degrees": degrees},
        sets={"volume.as_deep_as_wide": not shows},
        keys=("volume.as_deep_as_wide",),
    )


def _color(seen: Survey, config: Config) -> Decision:
    kept = decibels(seen.one_hue_error)
    is_one = kept >= LEAST_ONE_HUE_DB
    way = "is more than any fit reaches" if is_one else f"is less than the {LEAST_ONE_HUE_DB:.0f} dB that would do"
    reason = f"The clip with one hue for all smoke is the same to {kept:.1f} dB, which {way}."
    value = "one_hue" if is_one else "full"
    return Decision(
        name="color",
        value=value,
        reason=reason,
        measured={"one_hue_db": kept},
        sets={"visual.color": value},
        keys=("visual.color",),
    )


def _particles(seen: Survey, config: Config) -> Decision:
    """As many visual particles as the settings allow, or fewer where the smoke covers too few pixels to show them."""
    width, height = _scaled(seen.source_size, min(config.frames.working_size, max(seen.source_size)))
    covered = seen.fullest_share * width * height
    useful, allowed = max(FEWEST_PARTICLES, round(PARTICLES_A_PIXEL * covered)), config.visual.num_particles
    value = min(allowed, useful)
    reason = f"The smoke covers at most {covered:.0f} pixels, which show {useful} particles; the settings allow {allowed}."
    return Decision(
        name="particles",
        value=value,
        reason=reason,
        measured={"smoke_pixels": covered},
        sets={"visual.num_particles": value} if value < allowed else {},
        keys=("visual.num_particles",),
    )


def _scaled(size: tuple[int, int], longest: int) -> tuple[int, int]:
    config = FramesConfig(working_size=max(16, longest))
    share = min(1.0, config.working_size / max(size))
    return max(8, round(size[0] * share)), max(8, round(size[1] * share))


def _warnings(decisions: Sequence[Decision]) -> tuple[Warned, ...]:
    camera = next(decision for decision in decisions if decision.name == "camera")
    if camera.value != "moving":
        return ()
    message = (
        f"The camera moves (the background shifts by {camera.measured['displacement']:.0%} of the picture); for now it is "
        "treated as if it stood still. Give the solved camera with --cameras cameras.json."
    )
    return (Warned(code="camera_moves", message=message),)
