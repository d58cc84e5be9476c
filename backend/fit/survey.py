"""What a clip shows, measured on a few of its frames at a small size, before anything is decided or fitted."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.job import Config, FramesConfig
from backend.fit import stabilise
from backend.fit.camera_path import fitting
from backend.fit.colors import error_of_one_hue, hue_of
from backend.fit.extraction import extract
from backend.fit.scene import make_scene, turned_about
from backend.fit.stabilise import ImageMotion
from backend.io.images import linear_to_srgb
from backend.io.video import Clip
from backend.io.working_frames import has_premultiplied_alpha, reduced, working_size
from backend.reporting import Report, SilentReport
from backend.stopwatch import Stopwatch

MAX_FRAMES = 48  # looked at, spread over the part that is decoded
MAX_DECODED = 900  # frames; the end of a longer clip is not looked at
MAX_SIDE = 320  # px
SMOKE_OPACITY = 0.05
DETAIL_SHARES = (0.35, 0.5, 0.7)  # of the size looked at
_DETAIL_FRAMES = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """Seconds that this machine took for this clip, of one thread: a clip's decoding cannot be known from its size."""

    decode: float  # a frame of the clip
    reduce: float  # a frame, to the size looked at
    prepare: float  # what the smoke layer needs once, at the size looked at
    extract: float  # the smoke layer of a frame at the size looked at
    whole: float  # all of the survey


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey:
    """size: (width, height) px at which the clip was looked at; source_size: of the clip. num_frames: to be fitted.

    smoke_share, fullest_share: of the picture that smoke covers, in the mean and in the frame with most of it.
    one_hue_error: mean squared error (sRGB on black) that one hue for all smoke would make. detail_errors: the same for
    pictures reduced to a share of their size and brought back. turn: radians that the camera goes around the smoke; 0
    for one that stands still. has_cameras: they are given and used. motion: of the background, None where cameras are given
    or the clip shows no background. measured: of the extraction.
    """

    size: tuple[int, int]
    source_size: tuple[int, int]
    num_frames: int
    mode: str
    mode_reason: str
    measured: dict[str, float]
    smoke_share: float
    fullest_share: float
    opaque_share: float
    one_hue_error: float
    detail_errors: dict[float, float]
    turn: float
    has_cameras: bool
    motion: ImageMotion | None
    pace: Pace


def survey(
    clip: Clip,
    config: Config,
    report: Report,
    *,
    start: int,  # first frame to be fitted
    stop: int,  # behind the last one
    given: Cameras | None = None,  # of the whole clip
) -> Survey:
    """Looks at up to 48 frames. Raises BackendError, as a run would, where they show no smoke or cameras do not fit."""
    whole = Stopwatch()
    size = working_size(clip, FramesConfig(working_size=MAX_SIDE))
    numbers, frames, decode, reduce = _sampled(clip, size, start, stop, report)
    watch = Stopwatch()
    layer = extract(frames, config.extraction, SilentReport(), has_alpha=clip.has_alpha)
    preparing, watch = watch.seconds(), Stopwatch()
    layers = list(layer.frames)
    extracting = watch.seconds() / len(layers)
    shares = np.array([float(np.mean(image[..., 3] > SMOKE_OPACITY)) for image in layers])
    smoke = np.concatenate([image[..., 3][image[..., 3] > SMOKE_OPACITY] for image in layers])
    some = layers[:: max(1, len(layers) // _DETAIL_FRAMES)]
    is_given = given is not None and config.cameras.mode != "still"
    cameras = _sampled_cameras(given, numbers, start, stop - start, size, clip.fps) if given is not None and is_given else None
    scene = None if cameras is None or cameras.is_still else make_scene(layers, cameras)
    motion = _motion(frames, layers) if layer.mode == "matte" and not is_given else None
    return Survey(
        size=size,
        source_size=(clip.width, clip.height),
        num_frames=stop - start,
        mode=layer.mode,
        mode_reason=layer.reason,
        measured=layer.measured,
        smoke_share=float(shares.mean()),
        fullest_share=float(shares.max()),
        opaque_share=float(np.mean(smoke > 0.8)) if smoke.size else 0.0,
        one_hue_error=error_of_one_hue(some, hue_of(layers)),
        detail_errors={share: _detail_error(some, share) for share in DETAIL_SHARES},
        turn=0.0 if scene is None else turned_about(scene.views, scene.anchor),
        has_cameras=is_given,
        motion=motion,
        pace=Pace(decode=decode, reduce=reduce, prepare=preparing, extract=extracting, whole=whole.seconds()),
    )


def decibels(squared_error: float) -> float:
    """PSNR of a mean squared error, peak 1; at most 99, so that no error at all is a number, too."""
    return min(99.0, -10.0 * math.log10(max(squared_error, 1e-12)))


def _sampled(
    clip: Clip, size: tuple[int, int], start: int, stop: int, report: Report
) -> tuple[list[int], list[np.ndarray], float, float]:
    """Numbers and frames [h, w, 4] linear, evenly spread; seconds to decode one, and to reduce one."""
    last = min(stop, start + MAX_DECODED)
    count = min(last - start, MAX_FRAMES)
    numbers = np.unique(np.linspace(start, last - 1, count).round().astype(int)).tolist()
    is_premultiplied = clip.has_alpha and has_premultiplied_alpha(clip.frames(start, last))
    wanted, frames, reducing = set(numbers), [], 0.0
    watch = Stopwatch()
    for index, image in enumerate(clip.frames(start, last), start=start):
        if index in wanted:
            part = Stopwatch()
            frames.append(reduced(image, size, is_premultiplied=is_premultiplied))
            reducing += part.seconds()
        report.progress(index + 1 - start, last - start)
    decoding = max(watch.seconds() - reducing, 0.0)
    return numbers, frames, decoding / (last - start), reducing / len(frames)


def _sampled_cameras(given: Cameras, numbers: list[int], start: int, count: int, size: tuple[int, int], fps: float) -> Cameras:
    """The given cameras at the frames looked at. Raises BackendError where they do not fit the clip."""
    whole = fitting(given, count, start, size=size, fps=fps, report=SilentReport())
    if whole.is_still:
        return whole
    return dataclasses.replace(whole, camera_to_world=tuple(whole.camera_to_world[number - start] for number in numbers))


def _motion(frames: list[np.ndarray], layers: list[np.ndarray]) -> ImageMotion:
    return stabilise.measure_motion(frames, range(len(frames)), background=lambda k: stabilise.is_background(layers[k]))


def _detail_error(layers: list[np.ndarray], share: float) -> float:
    """Mean squared error, sRGB on black, of pictures reduced to a share of their size and brought back."""
    squares = [float(np.square(coded - again, dtype=np.float64).mean()) for coded, again in _there_and_back(layers, share)]
    return float(np.mean(squares))


def _there_and_back(layers: list[np.ndarray], share: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for layer in layers:
        color = np.clip(layer[..., :3], 0.0, 1.0)
        height, width = color.shape[:2]
        small = cv2.resize(color, (max(1, round(width * share)), max(1, round(height * share))), interpolation=cv2.INTER_AREA)
        again = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
        yield linear_to_srgb(color), linear_to_srgb(np.clip(again, 0.0, 1.0))
