"""A solid of triangles, read from a Wavefront .obj whose z axis points up and whose unit is the metre."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from backend.contract.errors import BackendError

from .signed_distance import BAND, signed_distance_grid

RESOLUTION = 64  # voxels along the longest side of the mesh
_HINT = "Export a closed mesh as Wavefront .obj, with z up."


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshCollider:
    """A closed mesh as signed distances on a lattice: node (i, j, k) is at origin + voxel_size (i, j, k), in m."""

    origin: np.ndarray  # [3] m
    voxel_size: float  # m
    values: np.ndarray  # [X, Y, Z] m, negative inside
    friction: float = 0.0

    def distances(
        self,
        positions: np.ndarray,  # [N, 3] m
    ) -> tuple[np.ndarray, np.ndarray]:  # [N] m, [N, 3]
        """Trilinear signed distance and its normalised gradient; off the lattice, what is nearest on it and the way there."""
        last = np.array(self.values.shape) - 1
        wanted = (positions - self.origin) / self.voxel_size
        inside = np.clip(wanted, 0.0, last)
        cell = np.minimum(np.floor(inside).astype(np.int64), last - 1)
        share = inside - cell
        values, slopes = np.zeros(len(positions)), np.zeros((len(positions), 3))
        for corner in np.ndindex(2, 2, 2):
            weights = np.where(np.array(corner) == 1, share, 1.0 - share)  # [N, 3]
            value = self.values[tuple((cell + corner).T)]
            values += weights.prod(axis=1) * value
            for axis in range(3):
                others = weights[:, (axis + 1) % 3] * weights[:, (axis + 2) % 3]
                slopes[:, axis] += (2 * corner[axis] - 1) * others * value
        away = (wanted - inside) * self.voxel_size
        beyond = np.sqrt(np.square(away).sum(axis=1))
        slopes = np.where((beyond > 0.0)[:, None], away, slopes)
        lengths = np.sqrt(np.square(slopes).sum(axis=1))
        is_level = lengths < 1e-12 * self.voxel_size  # in the middle of the solid every way out is as good; up is taken
        normals = np.where(is_level[:, None], [0.0, 0.0, 1.0], slopes / np.where(is_level, 1.0, lengths)[:, None])
        return values + beyond, normals


def make_collider(
    vertices: np.ndarray,  # [V, 3] m
    triangles: np.ndarray,  # [T, 3] int64
    *,
    friction: float = 0.0,
    resolution: int = RESOLUTION,
) -> MeshCollider:
    """The solid inside a closed mesh. Raises BackendError if the mesh has no inside."""
    used = vertices[np.unique(triangles)] if len(triangles) else np.zeros((0, 3))
    extent = float(np.ptp(used, axis=0).max()) if len(used) else 0.0
    if not (math.isfinite(extent) and extent > 0.0):
        raise BackendError("collider_empty", "The collider's mesh has no extent.", hint=_HINT)
    voxel_size = extent / resolution
    padding = math.ceil(BAND) + 1
    origin = used.min(axis=0) - padding * voxel_size
    spans = np.ceil(np.ptp(used, axis=0) / voxel_size).astype(np.int64) + 2 * padding + 1
    shape = (int(spans[0]), int(spans[1]), int(spans[2]))
    values = signed_distance_grid((vertices - origin) / voxel_size, triangles, shape) * voxel_size
    if not values.min() < 0.0:
        raise BackendError("collider_open", "The collider's mesh is not closed or too thin to have an inside.", hint=_HINT)
    return MeshCollider(origin=origin, voxel_size=voxel_size, values=values, friction=friction)


def read_collider(path: str | os.PathLike[str], *, friction: float = 0.0) -> MeshCollider:
    """The solid in an .obj file. Raises BackendError."""
    vertices, triangles = read_obj(path)
    return make_collider(vertices, triangles, friction=friction)


def read_obj(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and triangles [T, 3] of a Wavefront .obj; larger faces become fans. Raises BackendError."""
    try:
        lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError as error:
        raise BackendError("collider_missing", f"There is no collider at {path}.", hint="Give the path of an .obj.") from error
    except OSError as error:
        raise BackendError("collider_unreadable", f"{path} cannot be read: {error}.", hint=_HINT) from error
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        try:
            if words[:1] == ["v"]:
                vertices.append([float(word) for word in words[1:4]])
            elif words[:1] == ["f"]:
                corners = [_corner(word, len(vertices)) for word in words[1:]]
                triangles += [(corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)]
        except (ValueError, IndexError) as error:
            raise BackendError("collider_unreadable", f"Line {number} of {path} is no .obj: {error}.", hint=_HINT) from error
    if not triangles or not all(len(vertex) == 3 and all(map(math.isfinite, vertex)) for vertex in vertices):
        raise BackendError("collider_unreadable", f"{path} holds no usable faces.", hint=_HINT)
    return np.array(vertices), np.array(triangles, np.int64)


def _corner(word: str, num_vertices: int) -> int:
    """Index from 0 of a corner such as 7, 7/1, 7//3 or -1, the last vertex so far."""
    index = int(word.split("/")[0])
    index = index - 1 if index > 0 else num_vertices + index
    if not 0 <= index < num_vertices:
        raise IndexError(f"vertex {word} does not exist")
    return index
