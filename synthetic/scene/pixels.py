"""Images as arrays inside Blender: EXR in through Blender, 16-bit PNG out by hand.

By hand, because Blender's PNG divides colour by opacity, which loses the light of faint smoke.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import bpy
import numpy as np


def read_exr(path: Path) -> np.ndarray:
    """[H, W, 4] float32 linear, top row first."""
    image = bpy.data.images.load(str(path))
    try:
        width, height = image.size
        pixels = np.empty(width * height * 4, np.float32)
        image.pixels.foreach_get(pixels)
    finally:
        bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1].copy()


def srgb(linear: np.ndarray) -> np.ndarray:
    """Coded values 0..1, float64, of linear light (IEC 61966-2-1), clipped."""
    light = np.clip(linear.astype(np.float64), 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)


def encode_png(image: np.ndarray) -> bytes:  # [H, W, 4] linear
    """A 16-bit RGBA PNG (ISO 15948): colour sRGB-coded, the fourth channel as it is; both clipped to 0..1."""
    coded = srgb(image)
    coded[..., 3] = np.clip(image[..., 3], 0, 1)
    words = np.rint(coded * 65535).astype(">u2")
    height, width = words.shape[:2]
    rows = np.zeros((height, 1 + width * 8), np.uint8)  # each row begins with its filter, 0: none
    rows[:, 1:] = words.reshape(height, -1).view(np.uint8)
    header = struct.pack(">IIBBBBB", width, height, 16, 6, 0, 0, 0)
    chunks = (b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
