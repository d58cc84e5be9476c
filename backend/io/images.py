"""Still images, and the one place where sRGB-coded values become linear light and back.

sRGB transfer function: IEC 61966-2-1. Colour channels are coded, the fourth channel (alpha, opacity) never is.
"""

from __future__ import annotations

import os
from pathlib import Path

import av
import cv2
import numpy as np
from av.error import FFmpegError

from backend.contract.errors import BackendError

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear sRGB primaries, Y (IEC 61966-2-1)
_LINEAR_FORMATS = (".exr", ".hdr")  # hold linear light, not sRGB


def srgb_to_linear(coded: np.ndarray) -> np.ndarray:
    """Coded values 0..1 of any shape -> linear light, float. Negative values follow the straight part of the curve."""
    base = np.maximum((coded + 0.055) / 1.055, 0.0)
    return np.where(coded <= 0.04045, coded / 12.92, base**2.4)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear light of any shape -> coded values. Not clipped."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1.0 / 2.4) - 0.055)


def linear_to_srgb_slope(linear: np.ndarray) -> np.ndarray:
    """Derivative of linear_to_srgb."""
    return np.where(linear <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(linear, 0.0031308) ** (1.0 / 2.4 - 1.0))


_TABLE_8 = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
_TABLE_16 = srgb_to_linear(np.arange(65536) / 65535.0).astype(np.float32)


def decode_srgb(image: np.ndarray) -> np.ndarray:
    """[H, W, C] uint8 or uint16, sRGB-coded -> [H, W, C] float32 linear; a fourth channel is only scaled to 0..1."""
    if image.dtype == np.uint8:
        linear = cv2.LUT(image, _TABLE_8)
        scale = np.float32(1.0 / 255.0)
    elif image.dtype == np.uint16:
        linear = _TABLE_16[image]
        scale = np.float32(1.0 / 65535.0)
    else:
        raise ValueError(f"sRGB-coded images are uint8 or uint16, not {image.dtype}")
    linear = linear.reshape(image.shape)
    if image.shape[-1] == 4:
        linear[..., 3] = image[..., 3] * scale
    return linear


def encode_srgb(linear: np.ndarray, dtype: type[np.unsignedinteger] = np.uint8) -> np.ndarray:
    """[H, W, C] linear -> sRGB-coded dtype, clipped to 0..1, NaN to 0; a fourth channel is only scaled."""
    clipped = np.clip(np.nan_to_num(linear, nan=0.0), 0.0, 1.0)
    coded = linear_to_srgb(clipped)
    if linear.shape[-1] == 4:
        coded[..., 3] = clipped[..., 3]
    return (coded * np.iinfo(dtype).max + 0.5).astype(dtype)


def read_image(path: str | os.PathLike[str]) -> np.ndarray:
    """One image file -> [H, W, 3 or 4] uint8 or uint16, sRGB-coded. Raises BackendError.

    Files of linear light (EXR, HDR, float TIFF) are coded to 16 bits and clipped at 1.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BackendError("image_missing", f"{path} cannot be read.", hint="Check the path of the image.") from error
    image = _read_exr(path) if path.suffix.lower() == ".exr" else _decode_bytes(data)
    if image is None or image.size == 0:
        raise BackendError(
            "image_unreadable", f"{path} holds no image that can be read.", hint="Save it again as PNG, JPEG, TIFF or WebP."
        )
    if image.ndim == 2:
        image = image[..., None]
    if image.shape[2] == 1:
        image = np.repeat(image, 3, axis=2)
    elif image.shape[2] == 2:
        image = image[..., [0, 0, 0, 1]]
    if image.dtype in (np.uint8, np.uint16):
        return np.ascontiguousarray(image)
    if image.dtype.kind == "f":
        return encode_srgb(image.astype(np.float32), np.uint16)
    raise BackendError(
        "image_unreadable", f"{path} holds {image.dtype} samples.", hint="Save it again with 8 or 16 bits a channel."
    )


def read_linear(path: str | os.PathLike[str], *, size: tuple[int, int] | None = None) -> np.ndarray:
    """One image file -> [H, W, 3 or 4] float32 linear, resampled to size (width, height) where given."""
    image = decode_srgb(read_image(path))
    if size is not None and (image.shape[1], image.shape[0]) != size:
        is_smaller = size[0] < image.shape[1]
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR)
    return image


def write_png(path: str | os.PathLike[str], linear: np.ndarray, *, bit_depth: int = 8) -> None:
    """[H, W, 3 or 4] linear -> PNG, colour sRGB-coded, a fourth channel linear as it is. bit_depth: 8 or 16."""
    if linear.ndim != 3 or linear.shape[2] not in (3, 4):
        raise ValueError(f"an image is [H, W, 3 or 4], not {linear.shape}")
    coded = encode_srgb(linear, {8: np.uint8, 16: np.uint16}[bit_depth])
    order = [2, 1, 0, 3][: coded.shape[2]]
    _, data = cv2.imencode(".png", np.ascontiguousarray(coded[..., order]))
    Path(path).write_bytes(data.tobytes())


def _decode_bytes(data: bytes) -> np.ndarray | None:
    """[H, W] or [H, W, C] in RGB order."""
    if not data:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    if image is None or image.ndim == 2 or image.shape[2] < 3:
        return image
    return image[..., [2, 1, 0, 3][: image.shape[2]]]


def _read_exr(path: Path) -> np.ndarray | None:
    """[H, W, 3 or 4] float32 linear; OpenCV's wheel is built without OpenEXR, FFmpeg's decoder is not."""
    try:
        with av.open(str(path)) as container:
            frame = next(container.decode(video=0))
            has_alpha = any(component.is_alpha for component in frame.format.components)
            return frame.to_ndarray(format="gbrapf32le" if has_alpha else "gbrpf32le")
    except (FFmpegError, StopIteration, IndexError):
        return None
