"""PNG frames to an H.264 clip. Runs in the backend's environment (PyAV)."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from backend.contract.errors import BackendError
from backend.io.atomic import whole_file


def encode_clip(
    frames: Sequence[Path],
    target: Path,
    *,
    fps: float,
    quality: int = 14,  # x264's constant rate factor: 0 lossless .. 51
) -> None:
    """The frames as mp4, whole or absent; the same frames give the same bytes. Sizes must be even (4:2:0 colour)."""
    if not frames:
        raise ValueError("a clip needs at least one frame")
    with whole_file(target) as part, av.open(str(part), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = None
        for path in frames:
            image = cv2.imread(str(path), cv2.IMREAD_COLOR)
            if image is None:
                raise BackendError("frame_unreadable", f"{path} is no image.", hint="Remove it and render again.")
            if stream is None:
                stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = "yuv420p"
                _say_colors(stream.codec_context)
                # One thread: x264 decides differently with another number of them.
                stream.options = {"crf": str(quality), "preset": "slower", "threads": "1"}
            container.mux(stream.encode(av.VideoFrame.from_ndarray(_planes(image), format="yuv420p")))
        assert stream is not None
        container.mux(stream.encode())


def _say_colors(codec: av.VideoCodecContext) -> None:
    """What the numbers mean, by ITU-T H.273: BT.709 primaries, sRGB curve, BT.601 matrix, video range."""
    codec.color_primaries, codec.color_trc, codec.colorspace, codec.color_range = 1, 13, 6, 1


def _planes(image: np.ndarray) -> np.ndarray:  # [H, W, 3] uint8 BGR -> [3 H / 2, W] uint8
    """Y, Cb, Cr in video range, ITU-R BT.601-7 2.5.1-2.5.3, chroma averaged over 2 x 2 pixels.

    By hand, because the quick conversion in FFmpeg's scaler rounds down and darkens the clip by about two levels.
    """
    height, width = image.shape[:2]
    if height % 2 or width % 2:
        raise ValueError(f"a clip of {width}x{height} has no 4:2:0 colour; both must be even")
    blue, green, red = (image[..., channel].astype(np.float32) / 255 for channel in range(3))
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    planes = [16 + 219 * luma]
    for color, scale in ((blue, 1.772), (red, 1.402)):
        chroma = (color - luma) / scale
        planes.append(128 + 224 * chroma.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3)))
    packed = np.concatenate([plane.reshape(-1) for plane in planes])
    return np.rint(packed).astype(np.uint8).reshape(height * 3 // 2, width)
