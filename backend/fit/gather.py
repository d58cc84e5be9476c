"""A proposed volume gathered in depth: its smoke squeezed along the rays to where most of it lies.

A network that was taught by squared errors answers with a mean over all that could be: right in each voxel, and wider in depth
than any smoke. Seen from aside such a volume is a pale smear. Each ray is squeezed about its middle until its spread is at
most SPREAD times that of the silhouette's medial solid; the sum along the ray stays.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from backend.fit.depth_prior import DepthPrior
from backend.fit.guide import Guide
from backend.geometry.camera import View

SPREAD = 2.0  # times the solid's own
_SMOOTH = 4.0  # pixels over which the solid's thickness is evened out
_MOST_SQUEEZE = 6.0


def gathered(guide: Guide, view: View, solid: DepthPrior, *, spread: float = SPREAD) -> np.ndarray:
    """Density [X, Y, Z] 1/m on the guide's voxels. view: that of the volume's frame, in which `solid` was found."""
    own = guide.prior_of(view, solid)
    thickness = cv2.GaussianBlur(solid.half_thickness.astype(np.float32), (0, 0), _SMOOTH)
    centres = guide.lattice.centres().reshape(-1, 3)
    matrix = guide.stand.from_world
    pixels, depth = view.project((centres - matrix[:3, 3]) @ matrix[:3, :3])
    at = pixels.T[::-1] - 0.5

    def seen(image: np.ndarray) -> np.ndarray:
        return ndimage.map_coordinates(image.astype(np.float64), at, order=1, mode="nearest")

    middle, half = seen(own.center_depth), seen(own.half_thickness)
    allowed = spread * np.maximum(seen(thickness), 0.5 * guide.lattice.voxel_size)
    squeeze = np.clip(half / allowed, 1.0, _MOST_SQUEEZE)
    source = np.maximum(middle + (depth - middle) * squeeze, 1e-3 * middle)
    density = guide.density_at(view.unproject(pixels, source)) * squeeze
    return np.where(depth > 0, density, 0.0).reshape(guide.lattice.shape).astype(np.float32)
