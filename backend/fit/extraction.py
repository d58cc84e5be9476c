"""Telling smoke from its background: by an alpha channel, on black, or by matting. Any sequence of frames goes in."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from backend.contract.errors import BackendError
from backend.contract.job import ExtractionConfig
from backend.fit import matte, on_black
from backend.fit.artist_masks import ArtistMasks, read_masks
from backend.fit.exposure import watched
from backend.fit.series import Series
from backend.reporting import Report

_SAMPLES = 24  # frames looked at to recognise what the clip shows
_MIN_SMOKE_SHARE = 2e-4  # of the sampled pixels; less is no smoke


@dataclass(frozen=True, slots=True, kw_only=True)
class SmokeLayer:
    """mode: "alpha", "on_black" or "matte", and in one sentence why. measured: the quantities behind it.

    plate: [h, w, 3] linear background of the first frame, None where the clip shows none. smoke_color: [3] linear, of
    opaque smoke. frames: [h, w, 4] float32 premultiplied linear RGB and opacity, one for each frame, in order.
    """

    mode: str
    reason: str
    measured: dict[str, float]
    plate: np.ndarray | None = field(repr=False)
    smoke_color: np.ndarray
    frames: Iterator[np.ndarray] = field(repr=False)


def extract(frames: Series[np.ndarray], config: ExtractionConfig, report: Report, *, has_alpha: bool) -> SmokeLayer:
    """frames: each [h, w, 4] linear RGB and straight alpha. Raises BackendError "no_smoke" where there is none."""
    mode, reason, measured, black = recognise(frames, config, has_alpha=has_alpha)
    height, width = frames[0].shape[:2]
    masks = read_masks(config, (width, height))
    if mode == "alpha":
        return _with_alpha(frames, masks, report, reason, measured)
    if mode == "on_black":
        return _on_black(frames, black, masks, report, reason, measured)
    return _matte(frames, config, masks, report, reason, measured)


def recognise(
    frames: Series[np.ndarray], config: ExtractionConfig, *, has_alpha: bool
) -> tuple[str, str, dict[str, float], on_black.BlackBackground]:
    """How the smoke is told from its background: mode, reason, measured quantities, and what is black about it."""
    samples = [frames[k] for k in _spread(len(frames), _SAMPLES)]
    black = on_black.measure_black(samples)
    measured = {
        "black_level": black.level,
        "black_noise": black.noise,
        "black_share": black.share,
        "black_border_share": black.border_share,
    }
    transparent = float(np.mean([np.mean(frame[..., 3] < 0.5) for frame in samples]))
    if has_alpha:
        measured["transparent_share"] = transparent
    if config.mode != "auto":
        if config.mode == "alpha" and not has_alpha:
            raise BackendError(
                "no_alpha", "The clip has no alpha channel.", hint='Set extraction.mode to "auto", "on_black" or "matte".'
            )
        return config.mode, "The settings say so.", measured, black
    if config.clean_plate:
        return "matte", "A clean plate was given.", measured, black
    if has_alpha and transparent > 0.0:
        return "alpha", f"The clip has an alpha channel; {transparent:.0%} of it is transparent.", measured, black
    if black.is_black:
        reason = (
            f"{black.share:.0%} of the picture and {black.border_share:.0%} of its border are black "
            f"(level {255 * black.level:.0f} of 255); opacity is taken from brightness."
        )
        return "on_black", reason, measured, black
    return "matte", f"The smoke stands before a background; only {black.share:.0%} of it is even and dark.", measured, black


def no_smoke(detail: str) -> BackendError:
    return BackendError(
        "no_smoke",
        f"No smoke was found: {detail}.",
        hint="Give a clip that shows smoke; if it does, paint it white in extraction.smoke_mask or give extraction.clean_plate.",
    )


def _spread(num_frames: int, num_samples: int) -> list[int]:
    """At most num_samples frame numbers, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, num_frames - 1, min(num_samples, num_frames)).round().astype(int)).tolist()


def _with_alpha(
    frames: Series[np.ndarray], masks: ArtistMasks, report: Report, reason: str, measured: dict[str, float]
) -> SmokeLayer:
    def layer(frame: np.ndarray) -> np.ndarray:
        return masks.limited(np.concatenate([frame[..., :3] * frame[..., 3:], frame[..., 3:]], axis=2))

    samples = [layer(frames[k]) for k in _spread(len(frames), _SAMPLES)]
    _check_smoke(samples, measured, "the alpha channel is empty")
    return SmokeLayer(
        mode="alpha",
        reason=reason,
        measured=measured,
        plate=None,
        smoke_color=_mean_color(samples),
        frames=_streamed(frames, report, lambda index: layer(frames[index])),
    )


def _on_black(
    frames: Series[np.ndarray],
    black: on_black.BlackBackground,
    masks: ArtistMasks,
    report: Report,
    reason: str,
    measured: dict[str, float],
) -> SmokeLayer:
    def layer(frame: np.ndarray) -> np.ndarray:
        return masks.limited(on_black.layer_on_black(frame, black))

    samples = [layer(frames[k]) for k in _spread(len(frames), _SAMPLES)]
    measured["opaque_luminance"] = black.peak
    detail = (
        "the picture is black throughout"
        if black.level <= on_black.MAX_BLACK_LEVEL
        else "nothing is brighter than the background"
    )
    _check_smoke(samples, measured, detail)
    return SmokeLayer(
        mode="on_black",
        reason=reason,
        measured=measured,
        plate=None,
        smoke_color=_mean_color(samples),
        frames=_streamed(frames, report, lambda index: layer(frames[index])),
    )


def _matte(
    frames: Series[np.ndarray],
    config: ExtractionConfig,
    masks: ArtistMasks,
    report: Report,
    reason: str,
    measured: dict[str, float],
) -> SmokeLayer:
    numbers = _spread(len(frames), config.plate_frames)
    prepared = matte.prepare(frames, numbers, config, masks, on_step=lambda k, n: report.progress(k, n + len(frames)))
    measured |= prepared.measured
    if prepared.smoke is None:
        raise no_smoke("nothing in front of the background changes or stands out the way smoke does")
    samples = [masks.limited(prepared.layer(frames[k], k)) for k in numbers[:: max(1, len(numbers) // _SAMPLES)]]
    _check_smoke(samples, measured, "what differs from the background is too little or does not look like smoke")
    for code, message in prepared.warnings:
        report.warning(code, message)
    return SmokeLayer(
        mode="matte",
        reason=f"{reason} {prepared.reason}",
        measured=measured,
        plate=prepared.clear_picture(frames[0]),
        smoke_color=prepared.smoke.linear,
        frames=_streamed(frames, report, lambda index: masks.limited(prepared.layer(frames[index], index)), done=len(numbers)),
    )


def _streamed(
    frames: Series[np.ndarray], report: Report, layer: Callable[[int], np.ndarray], *, done: int = 0
) -> Iterator[np.ndarray]:
    layers = (layer(index).astype(np.float32) for index in range(len(frames)))
    for index, image in enumerate(watched(layers, report)):
        yield image
        report.progress(done + index + 1, done + len(frames))


def _check_smoke(samples: list[np.ndarray], measured: dict[str, float], detail: str) -> None:
    """Raises BackendError where the samples hold no smoke; notes how much there is."""
    measured["smoke_share"] = float(np.mean([np.mean(s[..., 3] > 0.05) for s in samples]))
    measured["opacity_peak"] = float(max(s[..., 3].max() for s in samples))
    if measured["smoke_share"] < _MIN_SMOKE_SHARE:
        raise no_smoke(detail)


def _mean_color(samples: list[np.ndarray]) -> np.ndarray:
    """[3] linear: colour of the smoke where it is opaque, as the mean weighted by opacity."""
    light = np.sum([s[..., :3].sum(axis=(0, 1), dtype=np.float64) for s in samples], axis=0)
    return (light / max(np.sum([s[..., 3].sum(dtype=np.float64) for s in samples]), 1e-9)).astype(np.float32)
