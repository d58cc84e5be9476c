"""Rays through density grids: an integral known by hand, the adjoint, the cameras' conventions, threads and extremes."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from backend.field import rays
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice

LATTICE = Lattice(origin=(-1.9, -2.1, -1.6), voxel_size=0.2, shape=(20, 21, 18))


def look(position: tuple[float, float, float], *, width: int = 50, height: int = 40, focal: float = 60.0) -> View:
    """A camera that looks at the origin; the middle of the picture is off the optical axis."""
    forward = -np.array(position) / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    matrix[:3, 3] = position
    return View(width=width, height=height, fx=focal, fy=1.1 * focal, cx=0.47 * width, cy=0.53 * height, camera_to_world=matrix)


VIEWS = (look((0.0, -9.0, 2.0)), look((7.0, -4.0, -1.0)), look((0.3, 0.2, 5.0)), look((0.3, 0.4, 0.2)))  # the last: inside


def ball(*, middle: tuple[float, float, float] = (0.2, -0.1, 0.3), width: float = 0.5, peak: float = 2.0) -> np.ndarray:
    squares = ((LATTICE.centres() - middle) ** 2).sum(axis=-1)
    return (peak * np.exp(-0.5 * squares / width**2)).astype(np.float32)


def test_a_ray_through_a_ball_sees_its_integral() -> None:
    """Through the middle of a Gaussian: peak * width * sqrt(2 pi); beside it exp(-d^2 / 2 width^2) of that."""
    view = VIEWS[0]
    image = rays.optical_depth(ball(), LATTICE, view)
    for offset in ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.0, -0.6)):
        point = np.array([(0.2, -0.1, 0.3)]) + offset
        pixel, _ = view.project(point)
        column, row = (pixel[0] - 0.5).astype(int)
        centre = view.unproject(np.array([[column + 0.5, row + 0.5]]), np.ones(1))[0] - view.position
        ray = centre / np.linalg.norm(centre)
        apart = np.array([0.2, -0.1, 0.3]) - view.position
        distance = np.linalg.norm(apart - (apart @ ray) * ray)
        expected = 2.0 * 0.5 * np.sqrt(2 * np.pi) * np.exp(-0.5 * (distance / 0.5) ** 2)
        assert image[row, column] == pytest.approx(expected, rel=0.04)  # voxels of 0.4 widths, linear in between


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("step", [0.5, 1.3])
def test_the_adjoint_is_one(view: View, step: float) -> None:
    random = np.random.default_rng(1)
    density = random.uniform(size=LATTICE.shape).astype(np.float32)
    image = random.normal(size=(view.height, view.width)).astype(np.float32)
    seen = rays.optical_depth(density, LATTICE, view, step=step)
    spread = rays.optical_depth_adjoint(image, LATTICE, view, step=step)
    left, right = np.vdot(seen.astype(np.float64), image), np.vdot(density, spread.astype(np.float64))
    assert abs(left - right) < 1e-5 * np.linalg.norm(seen) * np.linalg.norm(image)
    assert seen.max() > 0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_finer_step_changes_little(axis: int) -> None:
    coarse, fine = (rays.optical_depth(ball(), LATTICE, VIEWS[axis], step=step) for step in (0.5, 0.1))
    assert np.abs(coarse - fine).max() < 0.01 * fine.max()


@pytest.mark.parametrize("view", VIEWS[:3])
def test_voxels_look_up_the_pixel_they_project_to(view: View) -> None:
    y, x = np.mgrid[0 : view.height, 0 : view.width] + 0.5
    found = np.stack([rays.at_voxels(plane.astype(np.float32), LATTICE, view, outside=-1.0) for plane in (x, y)], axis=-1)
    pixels, depth = view.project(LATTICE.centres().reshape(-1, 3))
    pixels = pixels.reshape(*LATTICE.shape, 2)
    low, high = np.array([0.5, 0.5]), np.array([view.width - 0.5, view.height - 0.5])
    inside = ((pixels > low) & (pixels < high)).all(-1) & (depth.reshape(LATTICE.shape) > 0)
    assert inside.sum() > 100
    assert np.abs(found[inside] - pixels[inside]).max() < 1e-3
    outside = ((pixels < -0.5) | (pixels > high + 1.0)).any(-1)
    assert (found[outside] == -1.0).all()


@pytest.mark.parametrize("axis", [0, 2])
def test_a_voxel_that_leaves_the_picture_fades(axis: int) -> None:
    """No step that rounding could take: the value falls to that of outside over one pixel."""
    view = VIEWS[0]
    way = np.linspace(-12.0, 12.0, 4001)
    origins = np.zeros((len(way), 3))
    origins[:, axis] = way
    image = np.full((view.height, view.width), 3.0, np.float32)
    points = [Lattice(origin=tuple(origin), voxel_size=0.2, shape=(1, 1, 1)) for origin in origins]  # type: ignore[arg-type]
    found = np.array([rays.at_voxels(image, point, view, outside=1.0)[0, 0, 0] for point in points])
    pixels, _ = view.project(origins)
    moved = np.linalg.norm(np.diff(pixels, axis=0), axis=1)
    assert found.min() == 1.0 and found.max() == 3.0
    assert (np.abs(np.diff(found)) <= 2.0 * moved + 1e-5).all()


def test_what_is_behind_the_camera_is_not_looked_up() -> None:
    view = VIEWS[3]
    found = rays.at_voxels(np.ones((view.height, view.width), np.float32), LATTICE, view)
    depth = view.to_camera(LATTICE.centres().reshape(-1, 3))[:, 2].reshape(LATTICE.shape)
    assert found[depth <= 0].max() == 0.0 and found.max() == 1.0


def test_equal_bytes_for_any_number_of_threads() -> None:
    view, density = VIEWS[1], ball()
    image = rays.optical_depth(density, LATTICE, view)
    kept = numba.get_num_threads()
    answers = []
    try:
        for threads in (1, kept):
            numba.set_num_threads(threads)
            answers.append((rays.optical_depth(density, LATTICE, view), rays.optical_depth_adjoint(image, LATTICE, view)))
    finally:
        numba.set_num_threads(kept)
    for one, other in zip(*answers, strict=True):
        assert one.tobytes() == other.tobytes()


def test_beside_and_behind_there_is_nothing() -> None:
    away = View(
        width=8, height=6, fx=50.0, fy=50.0, cx=4.0, cy=3.0, camera_to_world=look((0.0, -9.0, 0.0)).camera_to_world.copy()
    )
    away.camera_to_world[:3, 3] = (0.0, 9.0, 0.0)  # looks on, past the grid
    assert not rays.optical_depth(ball(), LATTICE, away).any()
    assert not rays.optical_depth_adjoint(np.ones((6, 8)), LATTICE, away).any()


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        rays.optical_depth(np.zeros((2, 2, 2)), LATTICE, VIEWS[0])
    for function in (rays.optical_depth_adjoint, rays.at_voxels):
        with pytest.raises(ValueError, match="does not fit"):
            function(np.zeros((3, 3)), LATTICE, VIEWS[0])
