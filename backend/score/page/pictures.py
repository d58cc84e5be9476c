"""Pictures for the report: JPEG inside the page, differences and volumes as pictures."""

from __future__ import annotations

import base64

import cv2
import numpy as np

FULL_DIFFERENCE = 0.25  # of coded light: what is shown in full colour
_BRIGHTER, _DARKER = np.array([1.0, 0.55, 0.1]), np.array([0.15, 0.6, 1.0])  # told apart by all common eyes
_LARGEST = 300  # px of the longer side
_QUALITY = 85


def inline(picture: np.ndarray, *, is_smooth: bool = True) -> str:
    """[H, W, 3] 0..1, coded -> a data URL. is_smooth: enlarged softly; else voxels stay squares."""
    scale = _LARGEST / max(picture.shape[:2])
    size = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
    if scale < 1.0:
        picture = cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    elif not is_smooth and scale >= 2.0:
        picture = np.repeat(np.repeat(picture, int(scale), axis=0), int(scale), axis=1)
    values = np.rint(255.0 * np.clip(picture[..., ::-1], 0.0, 1.0)).astype(np.uint8)
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(values), (cv2.IMWRITE_JPEG_QUALITY, _QUALITY))
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} cannot be coded")
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def signed(values: np.ndarray, *, full: float) -> np.ndarray:
    """[H, W] -> [H, W, 3]: orange where positive, blue where negative, black at 0; in full colour at `full`."""
    share = np.clip(values / full if full > 0.0 else 0.0 * values, -1.0, 1.0)[..., None]
    return np.maximum(share, 0.0) * _BRIGHTER + np.maximum(-share, 0.0) * _DARKER


def difference(shown: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Of coded pictures [H, W, 3]: orange where ours is brighter, blue where it is darker."""
    return signed((shown - truth).mean(axis=2), full=FULL_DIFFERENCE)


def grey(values: np.ndarray, *, full: float) -> np.ndarray:
    """[H, W] -> [H, W, 3], white at `full`."""
    return np.repeat(np.clip(values / full if full > 0.0 else 0.0 * values, 0.0, 1.0)[..., None], 3, axis=2)


def upright(plane: np.ndarray) -> np.ndarray:
    """[A, B] with B counted upwards -> [B, A], top row first."""
    return plane.T[::-1]
