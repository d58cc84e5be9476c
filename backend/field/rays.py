"""Optical depth of a density grid along the rays of a view, its adjoint, and images looked up at voxels.

Rays are sampled at fixed distances from the camera, k * step, each sample trilinear between voxel centres and zero beyond
the outermost by one voxel:

    tau(pixel) = step * sum_k density(camera + k step ray)                                [1]

The adjoint is exact to rounding: sum_pixels tau(density) image = sum_voxels density adjoint(image). It is filled in slabs
along x, each by one thread in the order of the pixels: equal bytes for any number of threads.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from backend.field.lookup import among
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice

_SLAB = 4  # voxels along x
_PAD = 2  # voxels: a ray is followed to one beyond the outermost, and rounding may take it a hair further


def optical_depth(density: np.ndarray, lattice: Lattice, view: View, *, step: float = 0.5) -> np.ndarray:
    """[X, Y, Z] 1/m -> [H, W] float32; step in voxels. Raises ValueError if density does not fit the lattice."""
    values = _on_lattice(density, lattice)
    image = np.zeros((view.height, view.width), np.float32)
    _march(np.pad(values, _PAD), *_placed(lattice), _camera(view), step * lattice.voxel_size, image)
    return image


def optical_depth_adjoint(image: np.ndarray, lattice: Lattice, view: View, *, step: float = 0.5) -> np.ndarray:
    """[H, W] -> [X, Y, Z] float32, m: what a change of each voxel's density changes in the sum of image * optical depth."""
    if image.shape != (view.height, view.width):
        raise ValueError(f"an image of {image.shape} does not fit a view of {view.width}x{view.height}")
    density = np.zeros(lattice.shape, np.float32)
    pixels = np.ascontiguousarray(image, np.float32)
    _spread(pixels, *_placed(lattice), _camera(view), step * lattice.voxel_size, density)
    return density


def at_voxels(image: np.ndarray, lattice: Lattice, view: View, *, outside: float = 0.0) -> np.ndarray:
    """[H, W] -> [X, Y, Z] float32: the image where each voxel's centre is seen, bilinear between pixel centres; beside the
    outermost lie pixels of `outside`, the answer also for what is further beside the picture or not before the camera."""
    if image.shape != (view.height, view.width):
        raise ValueError(f"an image of {image.shape} does not fit a view of {view.width}x{view.height}")
    found = np.empty(lattice.shape, np.float32)
    _look_up(np.ascontiguousarray(image, np.float32), *_placed(lattice), _camera(view), np.float32(outside), found)
    return found


def _on_lattice(density: np.ndarray, lattice: Lattice) -> np.ndarray:
    if density.shape != lattice.shape:
        raise ValueError(f"a grid of {density.shape} does not fit a lattice of {lattice.shape}")
    return np.ascontiguousarray(density, np.float32)


def _placed(lattice: Lattice) -> tuple[np.ndarray, float]:
    return np.array(lattice.origin, np.float64), float(lattice.voxel_size)


def _camera(view: View) -> np.ndarray:
    """[16]: rotation camera to world row by row, position, fx, fy, cx, cy."""
    matrix = view.camera_to_world
    return np.concatenate([matrix[:3, :3].ravel(), matrix[:3, 3], [view.fx, view.fy, view.cx, view.cy]]).astype(np.float64)


@njit(cache=True, inline="always")
def _ray(camera, row, column, direction):  # pixel -> unit vector in the world
    x = (column + 0.5 - camera[14]) / camera[12]
    y = (row + 0.5 - camera[15]) / camera[13]
    length = math.sqrt(x * x + y * y + 1.0)
    for axis in range(3):
        direction[axis] = (camera[3 * axis] * x + camera[3 * axis + 1] * y + camera[3 * axis + 2]) / length


@njit(cache=True, inline="always")
def _along(camera, direction, distance, origin, h):  # where a ray is, in voxels from the first one's centre
    x = (camera[9] + distance * direction[0] - origin[0]) / h
    y = (camera[10] + distance * direction[1] - origin[1]) / h
    z = (camera[11] + distance * direction[2] - origin[2]) / h
    return x, y, z


@njit(cache=True, inline="always")
def _span(camera, direction, low, high):  # -> first and last distance inside the box, the first larger where there is none
    near, far = 0.0, 1e30
    for axis in range(3):
        position = camera[9 + axis]
        if abs(direction[axis]) < 1e-12:
            if position < low[axis] or position > high[axis]:
                return 1.0, 0.0
        else:
            a = (low[axis] - position) / direction[axis]
            b = (high[axis] - position) / direction[axis]
            near, far = max(near, min(a, b)), min(far, max(a, b))
    return near, far


@njit(cache=True, parallel=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _march(density, origin, h, camera, step, image):  # density with _PAD voxels of nothing on all sides: no sample has to ask
    nx, ny, nz = density.shape[0] - 2 * _PAD, density.shape[1] - 2 * _PAD, density.shape[2] - 2 * _PAD
    low, high = origin - h, origin + h * np.array([nx, ny, nz], np.float64)
    x0, y0, z0 = (camera[9:12] - origin) / h + _PAD
    for row in prange(image.shape[0]):
        direction = np.empty(3)
        for column in range(image.shape[1]):
            _ray(camera, row, column, direction)
            near, far = _span(camera, direction, low, high)
            first, last = math.ceil(near / step), math.floor(far / step)
            dx, dy, dz = direction[0] * step / h, direction[1] * step / h, direction[2] * step / h
            total = 0.0
            for index in range(first, last + 1):
                total += among(density, x0 + index * dx, y0 + index * dy, z0 + index * dz)
            image[row, column] = total * step


@njit(cache=True, parallel=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _spread(image, origin, h, camera, step, density):
    nx, ny, nz = density.shape
    for slab in prange((nx + _SLAB - 1) // _SLAB):
        begin, end = slab * _SLAB, min(nx, (slab + 1) * _SLAB)
        low, high = origin - h, origin + h * np.array([nx, ny, nz], np.float64)
        low[0], high[0] = origin[0] + (begin - 1) * h, origin[0] + end * h
        direction = np.empty(3)
        for row in range(image.shape[0]):
            for column in range(image.shape[1]):
                value = image[row, column] * step
                if value == 0.0:
                    continue
                _ray(camera, row, column, direction)
                near, far = _span(camera, direction, low, high)
                first, last = math.ceil(near / step), math.floor(far / step)
                for index in range(first, last + 1):
                    x, y, z = _along(camera, direction, index * step, origin, h)
                    i, j, k = math.floor(x), math.floor(y), math.floor(z)
                    fx, fy, fz = x - i, y - j, z - k
                    for a in range(2):
                        if i + a < begin or i + a >= end:
                            continue
                        wx = fx if a else 1.0 - fx
                        for b in range(2):
                            if j + b < 0 or j + b >= ny:
                                continue
                            wy = value * wx * (fy if b else 1.0 - fy)
                            if 0 <= k < nz:
                                density[i + a, j + b, k] += wy * (1.0 - fz)
                            if 0 <= k + 1 < nz:
                                density[i + a, j + b, k + 1] += wy * fz


@njit(cache=True, inline="always")
def _pixel(image, row, column, outside):
    if 0 <= row < image.shape[0] and 0 <= column < image.shape[1]:
        return image[row, column]
    return outside


@njit(cache=True, parallel=True, error_model="numpy")
def _look_up(image, origin, h, camera, outside, found):
    height, width = image.shape
    for i in prange(found.shape[0]):
        for j in range(found.shape[1]):
            for k in range(found.shape[2]):
                dx, dy = origin[0] + i * h - camera[9], origin[1] + j * h - camera[10]
                dz = origin[2] + k * h - camera[11]
                depth = camera[2] * dx + camera[5] * dy + camera[8] * dz
                found[i, j, k] = outside
                if depth <= 1e-9:
                    continue
                column = camera[12] * (camera[0] * dx + camera[3] * dy + camera[6] * dz) / depth + camera[14] - 0.5
                row = camera[13] * (camera[1] * dx + camera[4] * dy + camera[7] * dz) / depth + camera[15] - 0.5
                if not (-1.0 < column < width and -1.0 < row < height):
                    continue
                c, r = math.floor(column), math.floor(row)
                fc, fr = column - c, row - r
                upper = (1.0 - fc) * _pixel(image, r, c, outside) + fc * _pixel(image, r, c + 1, outside)
                lower = (1.0 - fc) * _pixel(image, r + 1, c, outside) + fc * _pixel(image, r + 1, c + 1, outside)
                found[i, j, k] = (1.0 - fr) * upper + fr * lower
