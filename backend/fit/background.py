"""The background behind the smoke at every frame: given, seen over time, or a clear sky."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from backend.contract.errors import BackendError
from backend.contract.job import ExtractionConfig
from backend.fit.clean_plate import CleanPlate, fill_smoothly, frame_noise, temporal_plate
from backend.fit.connected import components
from backend.fit.matting import SmokeColor, estimate_smoke_color
from backend.fit.series import Series
from backend.fit.sky import Sky, fit_sky
from backend.fit.stabilise import ImageMotion, measure_motion, warp
from backend.io.images import linear_to_srgb, read_linear, srgb_to_linear

MAX_MOTION_SAMPLES = 120
_RESTLESS, _RESTLESS_SHARE = 0.2, 0.1  # share of the frames in which a pixel differs; share of such pixels
_MAX_STRANGE = 0.2  # of the calm pixels above the skyline that are no clear sky
_CLEARANCE = 0.03  # of the height
_MEMORY = 256 * 2**20  # bytes of frames that the temporal plate may hold
_SKY_SPACING = 4  # frames between two fits of the sky of a moving camera
_MAX_SKY_FITS = 120
_MIN_SEEN = 0.6  # of the background of a camera that turns; less is a camera that travels
_MIN_SKY_FITS = 0.7  # share of the sampled frames in which a sky must be found


@dataclass(frozen=True, slots=True, kw_only=True)
class Background:
    """plate: of the first frame, where things were seen over time. skies: fits at `sky_frames`, of a moving camera.

    noise: sRGB code, of one frame. is_temporal: what differs from it has moved or changed.
    """

    plate: CleanPlate | None
    motion: ImageMotion
    skies: list[Sky]
    sky_frames: list[int]
    noise: float
    is_temporal: bool
    reason: str
    warnings: list[tuple[str, str]] = field(default_factory=list)
    measured: dict[str, float] = field(default_factory=dict)

    def at(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """The background of a frame: [h, w, 3] linear, and [h, w] bool, where it is known."""
        if self.plate is None:
            return self._sky_at(index)
        if self.motion.is_still:
            return self.plate.color, np.ones(self.plate.color.shape[:2], bool)
        from_first = np.linalg.inv(self.motion.between(index))
        moved = warp(self.plate.color, from_first)
        is_known = np.asarray(np.isfinite(moved).all(axis=2))
        return fill_smoothly(np.nan_to_num(moved), is_known), is_known

    def placed(self, mask: np.ndarray, index: int) -> np.ndarray:
        """A mask [h, w] bool of the first frame, as it lies in another frame."""
        if self.plate is None or self.motion.is_still:
            return mask
        moved = warp(mask.astype(np.float32)[..., None], np.linalg.inv(self.motion.between(index)))
        return np.nan_to_num(moved).reshape(mask.shape) > 0.5

    def unplaced(self, image: np.ndarray, index: int) -> np.ndarray:
        """An image [h, w] of a frame, as it lies in the first frame; 0 where it does not reach."""
        if self.plate is None or self.motion.is_still:
            return image
        return np.nan_to_num(warp(image[..., None], self.motion.between(index))).reshape(image.shape)

    def seeds(self, index: int) -> np.ndarray | None:
        """[h, w] bool: where smoke is recognised; None for everywhere. Close above a skyline the ground may look like it."""
        if self.plate is not None:
            return None
        height = self.skies[0].coded.shape[0]
        return np.arange(height)[:, None] < self._line_at(index) - _CLEARANCE * height

    def _line_at(self, index: int) -> np.ndarray:
        """[w] the skyline of a frame."""
        low, high, t = self._around(index)
        return (1.0 - t) * self.skies[low].skyline + t * self.skies[high].skyline

    def _around(self, index: int) -> tuple[int, int, float]:
        """The fits of the sky before and after a frame, and how far it is between them, 0..1."""
        position = float(np.interp(index, self.sky_frames, np.arange(len(self.skies))))
        low = int(position)
        return low, min(low + 1, len(self.skies) - 1), position - low

    def _sky_at(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Between the two fits around the frame, in proportion."""
        low, high, t = self._around(index)
        coded = (1.0 - t) * self.skies[low].coded + t * self.skies[high].coded
        is_above = np.arange(coded.shape[0])[:, None] + 0.5 < self._line_at(index)
        return srgb_to_linear(np.clip(coded, 0.0, 1.0)).astype(np.float32), is_above


def find_background(
    frames: Series[np.ndarray],
    numbers: Sequence[int],
    config: ExtractionConfig,
    *,
    on_step: Callable[[int, int], None],
) -> Background:
    """Chooses between a given plate, what was seen over time, and a clear sky.

    A still or turning camera sees the same background again: the plate over time. A travelling camera shows parallax,
    which no single plate holds; there only a sky is far enough away to be known.
    """
    indices = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MAX_MOTION_SAMPLES)).astype(int)).tolist()
    motion = measure_motion(frames, indices)
    measured = {"camera_displacement": motion.displacement, "camera_parallax": motion.parallax}
    height, width = frames[0].shape[:2]
    if config.clean_plate:
        color = read_linear(config.clean_plate, size=(width, height))[..., :3]
        ones = np.ones((height, width), bool)
        noise = frame_noise([linear_to_srgb(frames[k][..., :3]).astype(np.float32) for k in numbers[:8]])
        plate = CleanPlate(color=np.ascontiguousarray(color), is_seen=ones, noise=noise, activity=np.zeros(ones.shape))
        return Background(
            plate=plate, motion=motion, skies=[], sky_frames=[], noise=noise, is_temporal=False,
            reason="The clean plate was given.", measured=measured,
        )  # fmt: skip
    if motion.is_still:
        return _over_time(frames, numbers, motion, measured, on_step)
    turned = None if motion.has_parallax else _over_time(frames, numbers, motion, measured, on_step)
    if turned is not None and turned.measured["plate_seen_share"] > _MIN_SEEN:
        return turned
    before_sky = _before_sky(frames, motion, measured, on_step)
    if before_sky is not None:
        return before_sky
    if config.garbage_matte or config.smoke_mask:
        background = turned or _over_time(frames, numbers, motion, measured, on_step)
        text = "The camera travels and there is no clear sky behind the smoke; the matte is uncertain."
        return dataclasses.replace(background, warnings=[("matte_uncertain", text)])
    raise BackendError(
        "background_unknown",
        "The camera travels and there is no clear sky behind the smoke, so the background behind it cannot be told.",
        hint="Give the smoke cut out on black or with alpha, or paint extraction.garbage_matte around it.",
    )


def _over_time(
    frames: Series[np.ndarray],
    numbers: Sequence[int],
    motion: ImageMotion,
    measured: dict[str, float],
    on_step: Callable[[int, int], None],
) -> Background:
    """The plate of a camera that stands or turns."""
    height, width = frames[0].shape[:2]
    stride = max(1, -(-len(numbers) * height * width * 12 // _MEMORY))
    samples = []
    for step, number in enumerate(numbers[::stride]):
        image = frames[number][..., :3]
        samples.append(image if motion.is_still else warp(image, motion.between(number)))
        on_step(step, len(numbers))
    plate = temporal_plate(samples)
    smoke = _smoke_before(plate, samples)
    if smoke is not None:
        plate = temporal_plate(samples, smoke=smoke.linear)
    plate = _with_sky(plate)
    measured |= {
        "plate_seen_share": float(plate.is_seen.mean()),
        "plate_noise": plate.noise,
        "activity_share": float((plate.activity > 0.2).mean()),
    }
    camera = "stands still" if motion.is_still else "turns without travelling"
    reason = f"The camera {camera}; {plate.is_seen.mean():.0%} of the background was seen without smoke."
    return Background(
        plate=plate, motion=motion, skies=[], sky_frames=[], noise=plate.noise, is_temporal=True, reason=reason, measured=measured
    )


def _with_sky(plate: CleanPlate) -> CleanPlate:
    """The plate with clear sky in place of smoke that hangs before it all the time.

    What differs from the sky and lies above the skyline is such smoke if part of it changes; towers and clouds that
    keep still stay in the plate.
    """
    sky = fit_sky(plate.color)
    if sky is None or sky.skyline.max() < 1:
        return plate
    is_above = np.arange(len(plate.color))[:, None] < sky.skyline
    is_strange = is_above & (np.abs(linear_to_srgb(plate.color) - sky.coded).max(axis=2) > max(3.0 * sky.residual, 4.0 / 255))
    is_calm = is_above & plate.is_seen & (plate.activity < _RESTLESS)
    if is_strange[is_calm].sum() > _MAX_STRANGE * is_calm.sum():
        return plate  # what looked like sky at the top is something else
    num, labels = components(is_strange)
    restless = np.bincount(labels[(plate.activity > _RESTLESS) | ~plate.is_seen], minlength=num)
    is_smoke = restless > _RESTLESS_SHARE * np.bincount(labels.ravel(), minlength=num)
    is_smoke[0] = False
    clear = srgb_to_linear(np.clip(sky.coded, 0.0, 1.0)).astype(np.float32)
    return dataclasses.replace(plate, color=np.where(is_smoke[labels][..., None], clear, plate.color))


def _smoke_before(plate: CleanPlate, samples: list[np.ndarray]) -> SmokeColor | None:
    """A first guess of the smoke's colour, where the plate was seen."""
    images = [np.where(np.isfinite(sample), sample, plate.color) for sample in samples[:: max(1, len(samples) // 16)]]
    return estimate_smoke_color(images, [plate.color] * len(images), [plate.is_seen] * len(images), plate.noise)


def _before_sky(
    frames: Series[np.ndarray], motion: ImageMotion, measured: dict[str, float], on_step: Callable[[int, int], None]
) -> Background | None:
    """The sky behind the smoke of a camera that travels; None where there is no sky in most frames."""
    num = min(_MAX_SKY_FITS, max(2, -(-len(frames) // _SKY_SPACING)))
    numbers = np.unique(np.linspace(0, len(frames) - 1, num).round().astype(int)).tolist()
    skies, found = [], []
    for step, number in enumerate(numbers):
        sky = fit_sky(frames[number][..., :3])
        if sky is not None:
            skies.append(sky)
            found.append(number)
        on_step(step, len(numbers))
    measured["sky_found_share"] = len(found) / len(numbers)
    if len(found) < _MIN_SKY_FITS * len(numbers):
        return None
    noise = max(float(np.median([sky.residual for sky in skies])), 0.5 / 255)
    measured["sky_residual"] = noise
    return Background(
        plate=None, motion=motion, skies=skies, sky_frames=found, noise=noise, is_temporal=False, measured=measured,
        reason="The camera moves; the smoke is told from the clear sky behind it.",
    )  # fmt: skip
