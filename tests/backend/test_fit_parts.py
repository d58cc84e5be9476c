"""The parts of the fit, each on a case whose answer is known."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from backend.contract.cameras import Cameras
from backend.contract.job import VisualConfig
from backend.field.rays import optical_depth as optical_depth_of
from backend.fit import depth_prior, explain, image_motion
from backend.fit.appearance import FADES, WIDENS, Appearance
from backend.fit.depths import Depths
from backend.fit.foot import foot_point
from backend.fit.population import frame_mass, is_near_image, join, not_grown_beside, pixel_mass, take
from backend.fit.refine import as_gaussians, refine
from backend.fit.scene import Scene, make_scene, optical_depth
from backend.fit.state import VisualRecord, VolumeRecord
from backend.geometry.camera import View, view_at
from backend.prior.window import stand_before
from backend.render import splat as renderer
from backend.render.composite import composite

STILL = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -10.0), (0.0, -1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def cameras(width: int = 96, height: int = 96, matrices: tuple = (STILL,)) -> Cameras:
    return Cameras(
        width=width, height=height, fx=100.0, fy=100.0, cx=width / 2, cy=height / 2, fps=20.0, camera_to_world=matrices
    )


def disc(radius: float, center: tuple[float, float] = (48.0, 48.0), size: tuple[int, int] = (96, 96)) -> np.ndarray:
    """Optical depth one inside a disc [H, W]."""
    y, x = np.mgrid[0 : size[0], 0 : size[1]] + 0.5
    return (np.hypot(x - center[0], y - center[1]) < radius).astype(np.float32)


def layer_of(tau: np.ndarray, color: float = 0.6) -> np.ndarray:
    opacity = -np.expm1(-tau)
    return np.dstack([color * opacity] * 3 + [opacity]).astype(np.float32)


def look_at(position: np.ndarray, target: np.ndarray) -> tuple:
    """camera_to_world of an upright camera that looks at a point."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = right, np.cross(forward, right), forward, position
    return tuple(map(tuple, matrix.tolist()))


def test_a_disc_becomes_a_ball() -> None:
    view = view_at(cameras(), 0)
    prior = depth_prior.inflate(disc(20.0), view, np.zeros(3))
    metres = 10.0 / 100.0  # a pixel at the anchor's depth
    assert prior.half_thickness[48, 48] == pytest.approx(20 * metres, rel=0.06)
    assert prior.half_thickness[48, 48 + 12] == pytest.approx(16 * metres, rel=0.10)  # 12-16-20
    np.testing.assert_allclose(prior.center_depth, 10.0)


def test_a_full_image_and_an_empty_one_have_a_finite_depth() -> None:
    view = view_at(cameras(), 0)
    for tau in (np.zeros((96, 96), np.float32), np.full((96, 96), 5.0, np.float32)):
        prior = depth_prior.inflate(tau, view, np.zeros(3))
        assert np.isfinite(prior.half_thickness).all()
        assert (prior.half_thickness > 0).all()
        assert prior.half_thickness.max() < 10.0


def test_the_plane_of_a_camera_that_looks_down_is_upright() -> None:
    matrix = look_at(np.array([0.0, -10.0, 3.0]), np.zeros(3))
    view = view_at(cameras(matrices=(matrix,)), 0)
    depth = depth_prior.plane_depth(view, np.zeros(3))
    pixels = np.array([[48.0, 20.5], [48.0, 75.5]])
    points = view.unproject(pixels, depth[[20, 75], [47, 47]])
    np.testing.assert_allclose(points[:, 1], 0.0, atol=1e-9)


def test_samples_follow_the_weight_and_the_profile() -> None:
    view = view_at(cameras(), 0)
    tau = disc(20.0)
    prior = depth_prior.inflate(tau, view, np.zeros(3))
    points, pixels = depth_prior.sample_points(tau, 4000, prior, view, seed=3)
    assert len(points) == 4000
    assert (tau[pixels[:, 1].astype(int), pixels[:, 0].astype(int)] > 0).all()
    again, _ = depth_prior.sample_points(tau, 4000, prior, view, seed=3)
    np.testing.assert_array_equal(points, again)
    rows, columns = pixels[:, 1].astype(int), pixels[:, 0].astype(int)
    share = (view.to_camera(points)[:, 2] - 10.0) / prior.half_thickness[rows, columns]
    assert abs(share.mean()) < 0.01
    assert share.std() == pytest.approx(math.sqrt(1 / 6), rel=0.02)  # variance of (1 - s^2)^1.5 on -1..1 is 1/6
    assert np.abs(share).max() <= 1.0
    nothing, _ = depth_prior.sample_points(np.zeros((96, 96)), 100, prior, view, seed=0)
    assert nothing.shape == (0, 3)


def test_masses_explain_what_particles_could_have_drawn() -> None:
    random = np.random.default_rng(5)
    scene = make_scene([layer_of(disc(25.0))], cameras())
    appearance = Appearance(scene, [layer_of(disc(25.0))], VisualConfig(num_particles=400, iterations=0), 0)
    record, _ = appearance.look(appearance.empty(), 0)
    true = record.optical_masses * random.uniform(0.5, 1.5, len(record.optical_masses)).astype(np.float32)
    splat = renderer.forward(as_gaussians(record), scene.views[0])
    target = renderer.reweighted(splat, true).image[0]
    before = np.abs(splat.image[0] - target).sum()
    fitted, masses = explain.fit_masses(splat, record.optical_masses, target, iterations=60, consistency=0.0)
    assert np.abs(fitted.image[0] - target).sum() < 0.1 * before
    assert masses.sum() == pytest.approx(true.sum(), rel=0.01)
    _, kept = explain.fit_masses(splat, record.optical_masses, target, iterations=5, consistency=1.0)
    np.testing.assert_allclose(kept, record.optical_masses, rtol=1e-5)


def test_smoke_that_a_volume_has_far_behind_stays_there() -> None:
    """A faint cloud behind a thick one is not taken into the solid that the two together look like."""
    scene = make_scene([layer_of(disc(20.0))], cameras())
    stand = stand_before(scene.views[0], np.array([0.0, 1.5, 0.0]), voxel_size=0.35, shape=(24, 24, 40))
    away = stand.centres() * (2.0, 1.0, 2.0)
    near, far = (
        np.exp(-0.5 * np.square((away - (0.0, y, 0.0)) / (2.0, size, 2.0)).sum(-1)) for y, size in ((0.0, 0.5), (4.0, 0.4))
    )
    volume = VolumeRecord(
        density=(near + 0.1 * far).astype(np.float32),
        velocity=np.zeros((*near.shape, 3), np.float32),
        from_world=stand.from_world,
        voxel_size=np.asarray(0.35),
    )
    wanted = float((volume.density * (stand.centres()[..., 1] > 2.5)).sum() / volume.density.sum())
    layers = [layer_of(optical_depth_of(volume.density, stand.lattice, stand.seen(scene.views[0])))]
    appearance = Appearance(scene, layers, VisualConfig(num_particles=3000, iterations=0), 0, Depths(scene, layers, [volume]))
    record = appearance.empty()
    for _ in range(8):
        record, _ = appearance.look(record, 0)
    is_far = record.positions[:, 1] > 2.5
    found = record.optical_masses[is_far].sum() / record.optical_masses.sum()
    assert found == pytest.approx(wanted, rel=0.4)  # faint densities weigh less in every balance; a quarter was left of it


def ball_of_smoke() -> tuple[Scene, VolumeRecord, list[np.ndarray]]:
    """One frame of it, its volume, and its picture."""
    scene = make_scene([layer_of(disc(20.0))], cameras())
    stand = stand_before(scene.views[0], np.zeros(3), voxel_size=0.35, shape=(40, 24, 40))
    ball = np.exp(-0.5 * np.square(stand.centres()).sum(-1)).astype(np.float32)
    volume = VolumeRecord(
        density=ball, velocity=np.zeros((*ball.shape, 3), np.float32), from_world=stand.from_world, voxel_size=np.asarray(0.35)
    )
    layers = [layer_of(optical_depth_of(ball, stand.lattice, stand.seen(scene.views[0])))]
    return scene, volume, layers


@pytest.mark.parametrize("as_wide", [True, False])
def test_before_a_still_camera_no_particle_of_the_picture_strays_from_the_volume(as_wide: bool) -> None:
    scene, volume, layers = ball_of_smoke()
    depths = Depths(scene, layers, [volume])
    appearance = Appearance(scene, layers, VisualConfig(num_particles=2000, iterations=0), 0, depths, as_wide=as_wide)
    record, _ = appearance.look(appearance.empty(), 0)
    count, strayed = len(record.positions), np.array([[0.2, 3.8, 0.1], [-9.5, 3.8, 0.0]])  # the second beside the picture
    born = {"scales": [0.2] * 2, "colors": [[0.5] * 3] * 2, "born": [0] * 2, "optical_masses": [appearance.unit_mass] * 2}
    joined = join(record, positions=strayed, velocities=np.zeros((2, 3)), **{name: np.asarray(of) for name, of in born.items()})
    names = joined.ids[count : count + 2]
    for _ in range(8):
        joined, _ = appearance.look(joined, 0)
    found = {int(name): place for name, place in zip(joined.ids, joined.positions, strict=True)}
    inside, beside = (found[int(name)] for name in names)
    assert (inside[1] < 3.0) == as_wide
    np.testing.assert_array_equal(beside, strayed[1])


def test_smoke_that_has_left_the_picture_goes_on_widens_and_fades_with_its_way() -> None:
    """A volume that has nothing beside the picture takes nothing away there; particles in the picture follow it as before."""
    scene, volume, layers = ball_of_smoke()
    appearance = Appearance(scene, layers, VisualConfig(num_particles=2000, iterations=0), 0, Depths(scene, layers, [volume]))
    record, _ = appearance.look(appearance.empty(), 0)
    count, steps = len(record.positions), np.array([0.0, 0.1, 0.2, 0.4])  # m in a frame
    beside = np.array([[-6.3, 0.0, 0.0]] * 4)  # a metre and a half beside the left edge, which is 4.8 m from the middle
    masses = appearance.unit_mass * np.array([0.1, 0.5, 2.0, 10.0])
    born = {"scales": [0.05] * 4, "colors": [[0.5] * 3] * 4, "born": [0] * 4, "optical_masses": masses}
    born |= {"positions": beside, "velocities": np.outer(steps * 20.0, [0.0, 0.0, 1.0])}
    joined = join(record, **{name: np.asarray(values) for name, values in born.items()})
    found, _ = appearance.look(joined, 0)
    places = np.flatnonzero(found.ids >= joined.ids[count])[:4]
    np.testing.assert_array_equal(found.positions[places], beside)
    np.testing.assert_allclose(found.scales[places], 0.05 + WIDENS * steps, rtol=1e-5)
    fainter = 0.5 ** (steps * 10.0 / 96.0 / FADES)  # 10 px to a metre
    np.testing.assert_allclose(found.optical_masses[places], fainter * masses, rtol=1e-5)  # none goes back to the usual mass


def test_smoke_beside_the_picture_takes_nobodys_place() -> None:
    """The limit counts what the picture shows: a source goes on emitting while much of its smoke is beside the picture."""
    layer = layer_of(disc(20.0))
    scene = make_scene([layer], cameras())
    appearance = Appearance(scene, [layer], VisualConfig(num_particles=100, iterations=0), 0)
    alone, _ = appearance.look(appearance.empty(), 0)
    away = replace(alone, positions=alone.positions - (5.3, 0.0, 0.0), next_id=np.asarray(1000))
    away = take(away, alone.positions[:, 0] < 0.0)
    target = optical_depth(layer)
    both = appearance.with_births(away, 0, target)
    assert len(both.positions) - len(away.positions) == len(alone.positions) == 100
    back = replace(both, positions=both.positions + np.outer(both.positions[:, 0] < -4.8, (5.3, 0.0, 0.0)))
    seen = appearance.with_births(back, 0, 3.0 * target)
    assert 100 < len(seen.positions) <= len(back.positions)  # what comes back is kept, and nobody is born


def test_flow_gives_the_displacement_in_metres() -> None:
    random = np.random.default_rng(1)
    texture = cv2.GaussianBlur(random.random((96, 96)).astype(np.float32), (0, 0), 2.5)
    texture = (texture - texture.min()) / np.ptp(texture) * disc(30.0)
    shift = np.float32([[1, 0, 2.0], [0, 1, -1.0]])
    moved = cv2.warpAffine(texture, shift, (96, 96), flags=cv2.INTER_CUBIC)
    flow = image_motion.dense_flow(layer_of(1.5 * texture), layer_of(1.5 * np.maximum(moved, 0)))
    view = view_at(cameras(), 0)
    points = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.5]])
    wanted, confidence = image_motion.lift_flow(flow, -np.expm1(-1.5 * texture), points, (view, view))
    np.testing.assert_allclose(wanted, [[0.2, 0.0, 0.1]] * 2, atol=0.04)
    assert (confidence > 0).all()
    behind, none = image_motion.lift_flow(flow, texture, np.array([[0.0, -50.0, 0.0]]), (view, view))
    np.testing.assert_array_equal(behind, 0.0)
    np.testing.assert_array_equal(none, 0.0)


def test_a_camera_that_moves_past_still_smoke_sees_no_motion() -> None:
    first = view_at(cameras(matrices=(look_at(np.array([0.0, -10.0, 0.0]), np.zeros(3)),)), 0)
    second = view_at(cameras(matrices=(look_at(np.array([0.6, -10.0, 0.0]), np.array([0.3, 0.0, 0.0])),)), 0)
    points = np.array([[0.2, 0.3, -0.4], [-0.5, -0.2, 0.6]])
    pixels, _ = first.project(points)
    flow = np.zeros((96, 96, 2), np.float32)
    rows, columns = pixels[:, 1].astype(int), pixels[:, 0].astype(int)
    flow[rows, columns] = second.project(points)[0] - pixels
    wanted, _ = image_motion.lift_flow(flow, np.ones((96, 96)), points, (first, second))
    np.testing.assert_allclose(wanted, 0.0, atol=1e-6)


def test_refinement_lowers_the_error_and_stands_nothing_at_all() -> None:
    layer = layer_of(2.0 * cv2.GaussianBlur(disc(20.0), (0, 0), 3.0))
    layer[40:50, 40:50, :3] *= 0.5
    scene = make_scene([layer], cameras())
    appearance = Appearance(scene, [layer], VisualConfig(num_particles=800, iterations=0), 0)
    record, _ = appearance.look(appearance.empty(), 0)

    def error(of) -> float:
        shown, opacity = composite(renderer.forward(as_gaussians(of), scene.views[0], features=of.colors).image)
        return float(np.mean((shown - np.moveaxis(layer[..., :3], -1, 0)) ** 2) + np.mean((opacity - layer[..., 3]) ** 2))

    refined, _ = refine(record, layer, scene.views[0], iterations=25, reference_scale=appearance.scale)
    assert error(refined) < 0.5 * error(record)
    nobody, loss = refine(appearance.empty(), layer, scene.views[0], iterations=3, reference_scale=1.0)
    assert len(nobody.positions) == 0
    assert math.isfinite(loss)


def foot_of(layers: list[np.ndarray], given: Cameras) -> np.ndarray:
    """[3] m, of smoke layers."""
    views = [view_at(given, frame) for frame in range(len(layers))]
    return foot_point(lambda frame: optical_depth(layers[frame]), views)


@pytest.mark.parametrize("goes_out_at", [9, 5])
def test_rays_through_the_foot_of_the_smoke_meet_at_its_source(goes_out_at: int) -> None:
    """Also where the source goes out and what is left of the smoke drifts away."""
    source = np.array([0.4, -0.3, 0.0])
    angles = np.radians(np.linspace(-105, -45, 9))
    matrices = tuple(look_at(np.array([10 * math.cos(a), 10 * math.sin(a), 2.0]), np.array([0, 0, 1.0])) for a in angles)
    given = cameras(matrices=matrices)
    layers = []
    for index in range(len(matrices)):
        tau = np.zeros((96, 96), np.float32)
        for height, drift in zip(np.linspace(0, 1.5, 12), np.linspace(0, 0.6, 12), strict=True):
            if index >= goes_out_at and height < 0.7:
                continue
            gone = 0.3 * max(0, index - goes_out_at + 1)
            pixel = view_at(given, index).project(source[None] + [[drift + gone, 0, height]])[0][0]
            tau += 0.3 * disc(4.0 + 3 * height, tuple(pixel))
        layers.append(layer_of(tau))
    np.testing.assert_allclose(foot_of(layers, given), source, atol=0.25)
    np.testing.assert_allclose(make_scene(layers[:1], cameras()).anchor, 0.0, atol=1e-9)


def on_an_arc(degrees: float) -> tuple[np.ndarray, ...]:
    """Nine poses [4, 4] of a camera that goes around the world's origin and looks above it."""
    angles = np.radians(np.linspace(-90 - 0.5 * degrees, -90 + 0.5 * degrees, 9))
    return tuple(np.array(look_at(np.array([10 * math.cos(a), 10 * math.sin(a), 2.0]), np.array([0, 0, 3.0]))) for a in angles)


def plume_from(source: np.ndarray, poses: tuple[np.ndarray, ...]) -> list[np.ndarray]:
    """The smoke layers in which a foot stands at `source` [3] m, with more smoke over it."""
    feet = [view_at(cameras(matrices=(pose,)), 0).project(source[None])[0][0] for pose in poses]
    return [layer_of(disc(3.0, tuple(pixel)) + disc(9.0, (pixel[0], pixel[1] - 14))) for pixel in feet]


@pytest.mark.parametrize("degrees", [0.5, 8.0, 20.0])
def test_a_camera_that_turns_little_finds_the_source_on_its_ray(degrees: float) -> None:
    """Not at the height that the camera looks at; as far away as the rays and the world's origin say together."""
    source, poses = np.array([0.4, -0.3, 0.0]), on_an_arc(degrees)
    given = cameras(matrices=poses)
    foot = foot_of(plume_from(source, poses), given)
    seen, wanted = (view_at(given, 4).project(point[None])[0][0] for point in (foot, source))
    assert np.linalg.norm(seen - wanted) < 3.5  # px; the foot is not all in the lowest row
    assert np.linalg.norm(foot - source) < 0.5


def test_rays_refute_a_world_that_begins_elsewhere() -> None:
    source, poses = np.array([0.4, -0.3, 0.0]), on_an_arc(50.0)
    layers = plume_from(source, poses)
    expected = foot_of(layers, cameras(matrices=poses))
    for away in ([0.0, 25.0, 0.0], [0.0, -7.0, 0.0], [3e5, 1e6, -2e5]):
        shift = np.eye(4)
        shift[:3, 3] = np.negative(away)
        foot = foot_of(layers, cameras(matrices=tuple(shift @ pose for pose in poses))) + away
        np.testing.assert_allclose(foot, expected, atol=0.25)


def test_records_take_and_join() -> None:
    layer = layer_of(disc(20.0))
    scene = make_scene([layer], cameras())
    appearance = Appearance(scene, [layer], VisualConfig(num_particles=100, iterations=0), 0)
    record, _ = appearance.look(appearance.empty(), 0)
    half = take(record, np.arange(len(record.positions)) % 2 == 0)
    newborn = {
        name: getattr(half, name)[:3] for name in ("positions", "velocities", "scales", "optical_masses", "colors", "born")
    }
    more = join(half, **newborn)
    assert len(more.positions) == len(half.positions) + 3
    assert len(set(more.ids.tolist())) == len(more.ids)
    assert int(more.next_id) == int(record.next_id) + 3


def test_a_frames_mass_is_its_optical_depth_times_the_area() -> None:
    layer = layer_of(disc(20.0))
    scene = make_scene([layer], cameras())
    expected = float(optical_depth(layer).sum()) * (10.0 / 100.0) ** 2
    assert frame_mass(scene, layer, 0) == pytest.approx(expected, rel=1e-6)
    assert pixel_mass(scene.views[0], np.array(10.0)) == pytest.approx(0.01)


def test_who_is_near_the_image() -> None:
    view: View = view_at(cameras(), 0)
    points = np.array([[0.0, 0, 0], [8.0, 0, 0], [9.0, 0, 0], [0.0, -20.0, 0.0]])
    np.testing.assert_array_equal(is_near_image(points, view), [True, True, False, False])


SMALL = View(width=40, height=40, fx=40.0, fy=40.0, cx=20.0, cy=20.0, camera_to_world=np.eye(4))


def pair(positions: list[list[float]], *, masses: tuple[float, float], scale: float, color: float) -> VisualRecord:
    """Two particles, alike but for place and mass."""
    return VisualRecord(
        positions=np.array(positions),
        velocities=np.zeros((2, 3), np.float32),
        scales=np.full(2, scale, np.float32),
        optical_masses=np.array(masses, np.float32),
        colors=np.full((2, 3), color, np.float32),
        ids=np.arange(2),
        born=np.zeros(2, np.int32),
        next_id=np.asarray(2),
    )


def test_what_only_borders_on_the_image_does_not_grow() -> None:
    """A particle beside the image whose tail is the only one to reach a bright border pixel: explaining that pixel with it would
    take a thousand times its mass. It keeps its mass; one that is in the image grows."""
    beside, inside = [5.6, 0.0, 10.0], [0.0, 0.0, 10.0]  # 2.4 px to the right of the image; its middle
    layer = np.zeros((40, 40, 4), np.float32)
    layer[18:23, 39] = layer[18:23, 18:23] = 0.5
    record = pair([beside, inside], masses=(1e-3, 1e-3), scale=0.25, color=1.0)
    _, fitted = explain.fit_masses(
        renderer.forward(as_gaussians(record), SMALL), record.optical_masses, optical_depth(layer), iterations=12, consistency=0.0
    )
    assert fitted[0] > 100 * record.optical_masses[0]  # what would happen
    kept = not_grown_beside(fitted, record.optical_masses, record.positions, SMALL)
    assert kept[0] == record.optical_masses[0]
    assert kept[1] == fitted[1] > 10 * record.optical_masses[1]
    refined, _ = refine(record, layer, SMALL, iterations=20, reference_scale=0.25)
    assert refined.optical_masses[0] <= record.optical_masses[0]
    assert refined.optical_masses[1] > 1.5 * record.optical_masses[1]


def test_what_a_picture_hardly_tells_hardly_changes() -> None:
    """Two particles apart from each other, both twice as heavy as the picture says; of one it shows little."""
    record = pair([[-2.0, 0.0, 10.0], [2.0, 0.0, 10.0]], masses=(0.5, 0.05), scale=0.4, color=0.5)
    shown = replace(record, optical_masses=0.5 * record.optical_masses)
    splat = renderer.forward(as_gaussians(shown), SMALL, features=shown.colors)
    color, opacity = composite(splat.image)
    layer = np.concatenate([np.moveaxis(color, 0, -1), opacity[..., None]], axis=2)
    refined, _ = refine(record, layer, SMALL, iterations=8, reference_scale=0.4)
    change = np.log(refined.optical_masses / record.optical_masses)
    assert change[0] < -0.05
    assert abs(change[1]) < 0.3 * abs(change[0])
