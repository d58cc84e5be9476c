"""A closed mesh as a solid: signed distance to a dense sampling of its surface.

A point's nearest surface sample tells how far it is and, by that sample's normal, on which side. Samples lie closer
than 1/64 of the mesh's size, so the distance errs by less than that where it matters, near the surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from backend.contract.errors import BackendError

SAMPLES_PER_SIDE = 64  # of the mesh's longest side
_HINT = "Export the mesh as a closed Wavefront .obj, in metres, z up."


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshCollider:
    """The samples of a closed surface, with normals that point outward. friction: as of every collider."""

    points: np.ndarray  # [S, 3] m
    normals: np.ndarray  # [S, 3]
    tree: KDTree
    friction: float = 0.0

    def distances(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance [N] m, negative inside, and unit normals [N, 3] that point out."""
        _, nearest = self.tree.query(positions)
        normals = self.normals[nearest]
        return np.einsum("ij,ij->i", positions - self.points[nearest], normals), normals


def read_collider(path: str) -> MeshCollider:
    """A Wavefront .obj as a collider. Raises BackendError if it cannot be read or holds no surface."""
    try:
        lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise BackendError("collider_unreadable", f"{path} cannot be read.", hint="Check the path of the mesh.") from error
    try:
        vertices, triangles = _parse(lines)
    except (ValueError, IndexError) as error:
        raise BackendError("collider_unreadable", f"{path} is no mesh that can be read ({error}).", hint=_HINT) from error
    return make_collider(vertices, triangles, name=path)


def make_collider(
    vertices: np.ndarray,  # [V, 3] m
    triangles: np.ndarray,  # [T, 3] indices, counter-clockwise seen from outside, or all the other way round
    *,
    name: str = "the mesh",
) -> MeshCollider:
    """The collider of a closed mesh. Raises BackendError where it encloses nothing."""
    corners = vertices[triangles]  # [T, 3, 3]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(cross, axis=1)
    volume = float(np.einsum("ij,ij->i", corners[:, 0] - vertices.mean(axis=0), cross).sum()) / 6.0
    size = float(np.ptp(vertices, axis=0).max(initial=0.0)) if len(vertices) else 0.0
    if not size > 0.0 or abs(volume) < 1e-9 * size**3:
        raise BackendError("collider_empty", f"{name} encloses no volume.", hint=_HINT)
    keep = double_area > 1e-14 * size * size
    corners, cross, double_area = corners[keep], cross[keep], double_area[keep]
    normals = np.sign(volume) * cross / double_area[:, None]
    points, of_triangle = _sampled(corners, spacing=size / SAMPLES_PER_SIDE)
    return MeshCollider(points=points, normals=normals[of_triangle], tree=KDTree(points))


def _sampled(corners: np.ndarray, *, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [S, 3] on triangles [T, 3, 3], no two neighbours further apart than `spacing`, and the triangle of each."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    points, owners = [], []
    for triangle, (corner, edge) in enumerate(zip(corners, longest, strict=True)):
        count = max(1, int(np.ceil(edge / spacing)))
        i, j = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
        inside = i + j < count
        u, v = (i[inside] + 1 / 3) / count, (j[inside] + 1 / 3) / count
        points.append(corner[0] + u[:, None] * (corner[1] - corner[0]) + v[:, None] * (corner[2] - corner[0]))
        owners.append(np.full(len(u), triangle))
    return np.concatenate(points), np.concatenate(owners)


def _parse(lines: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and triangles [T, 3] of a Wavefront file; polygons are fanned."""
    vertices, triangles = [], []
    for line in lines:
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(word) for word in words[1:4]])
        elif words[:1] == ["f"]:
            corners = [int(word.split("/")[0]) for word in words[1:]]
            corners = [corner - 1 if corner > 0 else len(vertices) + corner for corner in corners]
            triangles += [[corners[0], corners[k], corners[k + 1]] for k in range(1, len(corners) - 1)]
    table, faces = np.array(vertices, np.float64).reshape(-1, 3), np.array(triangles, np.int64).reshape(-1, 3)
    if not len(faces):
        raise ValueError("it has no faces")
    if faces.min() < 0 or faces.max() >= len(table) or not np.isfinite(table).all():
        raise ValueError("a face names a vertex that is not there, or a coordinate is not finite")
    return table, faces
