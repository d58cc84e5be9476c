"""The forecast: parcels that go on as they went, how far they are trusted, and clips with little in them."""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from backend.contract.cameras import Cameras
from backend.contract.errors import Cancelled
from backend.contract.job import ForecastConfig, PublishedConfig
from backend.fit.future import DOUBT, RECENT, Trust, recent_guides, recent_velocity, trust_of
from backend.fit.guide import Guide
from backend.fit.scene import make_scene
from backend.fit.state import PhysicalRecord, VisualRecord, VolumeRecord, particle_frame
from backend.published import future as published_future
from backend.render.picture import picture
from backend.reporting import SilentReport
from backend.score.measures import decibels, squared_errors
from backend.stages import forecast
from synthetic.sweep import Orbit, orbit_cameras

FPS = 10.0
UP = np.array([0.0, 0.0, 1.0])


def look_along_y() -> np.ndarray:
    """10 m before the origin; x to the right, z up."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]).T
    matrix[:3, 3] = (0.0, -10.0, 0.0)
    return matrix


CAMERAS = Cameras(
    width=48, height=64, fx=80.0, fy=80.0, cx=24.0, cy=32.0, fps=FPS,
    camera_to_world=(tuple(tuple(float(value) for value in row) for row in look_along_y()),),
)  # fmt: skip
VIEW = make_scene([np.zeros((64, 48, 4), np.float32)], CAMERAS).views[0]


def visual(positions: np.ndarray, velocities: np.ndarray | None = None, *, born: int = 0, mass: float = 0.02) -> VisualRecord:
    count = len(positions)
    return VisualRecord(
        positions=np.asarray(positions, np.float64).reshape(count, 3),
        velocities=np.zeros((count, 3), np.float32) if velocities is None else np.asarray(velocities, np.float32),
        scales=np.full(count, 0.2, np.float32),
        optical_masses=np.full(count, mass, np.float32),
        colors=np.full((count, 3), 0.5, np.float32),
        ids=np.arange(count, dtype=np.int64),
        born=np.full(count, born, np.int32),
        next_id=np.asarray(count, np.int64),
    )


def physical(positions: np.ndarray, velocity: np.ndarray) -> PhysicalRecord:
    count = len(positions)
    return PhysicalRecord(
        positions=np.asarray(positions, np.float64).reshape(count, 3),
        velocities=np.broadcast_to(np.asarray(velocity, np.float64), (count, 3)).copy(),
        masses=np.full(count, 0.02),
        ids=np.arange(count, dtype=np.int64),
        born=np.zeros(count, np.int32),
        next_id=np.asarray(count, np.int64),
        smoothing_length=np.asarray(0.8),
        rest_density=np.asarray(20.0),
        buoyancy=np.zeros(3),
        buoyancy_weight=np.asarray(0.0),
        buoyancy_moment=np.zeros(3),
        buoyancy_square=np.zeros(3),
    )


def volume(velocity: np.ndarray) -> VolumeRecord:
    return VolumeRecord(
        density=np.ones((6, 6, 6), np.float32),
        velocity=np.broadcast_to(np.asarray(velocity, np.float32), (6, 6, 6, 3)).copy(),
        from_world=np.eye(4),
        voxel_size=np.asarray(1.0),
    )


def cloud(count: int = 120, *, seed: int = 0, size: float = 0.5) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, size, (count, 3))


def clip(
    velocity: np.ndarray, *, num_frames: int = 5, count: int = 120
) -> tuple[list[np.ndarray], list[PhysicalRecord], list[VisualRecord]]:
    """A cloud that flies by as it is: smoke layers, physical and visual records."""
    seen = [visual(cloud(count) + frame / FPS * velocity, np.tile(velocity, (count, 1))) for frame in range(num_frames)]
    layers = [picture(particle_frame(record), VIEW) for record in seen]
    return layers, [physical(record.positions, velocity) for record in seen], seen


def run(parts: tuple, config: ForecastConfig, **more: object) -> list[VisualRecord]:
    layers, fluid, seen = parts
    return list(forecast.run(layers, CAMERAS, fluid, seen, config, SilentReport(), **more))  # type: ignore[arg-type]


MOVING = np.array([0.6, 0.2, 0.8])
PURE = ForecastConfig(num_frames=4, fading=0.0, spreading=0.0)


# -- how far it is trusted -----------------------------------------------------------------------------------------------


def test_trust_by_hand() -> None:
    trust = Trust(speed=2.0, rate=0.5, spreading=0.1)
    assert trust.share_moved(3.0) == pytest.approx(math.exp(-1.5))
    assert trust.growth(3.0) == pytest.approx(0.6)
    assert trust.deviation(3.0) == pytest.approx(6.0 * DOUBT)
    assert (trust.share_moved(0.0), trust.growth(0.0), trust.deviation(0.0)) == (1.0, 0.0, 0.0)


def test_trust_of_a_box_by_hand() -> None:
    """Corners of a box of half sides 1, 2, 4: its size is 2. Half of the mass moves at 2 m/s: root mean square sqrt(2)."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-2, 2) for z in (-4, 4)], float)
    record = visual(corners + 100.0, np.where(np.arange(8)[:, None] % 2 == 0, 2.0 * UP, 0.0))
    trust = trust_of(record, ForecastConfig(fading=0.3, spreading=0.2))
    assert trust.speed == pytest.approx(math.sqrt(2.0))
    assert trust.rate == pytest.approx(0.3 * math.sqrt(2.0) / 2.0)
    assert trust.spreading == 0.2


@pytest.mark.parametrize("scale", [1e-4, 1e5])
def test_trust_does_not_know_metres(scale: float) -> None:
    record, config = visual(cloud(), np.tile(MOVING, (120, 1))), ForecastConfig()
    larger = replace(record, positions=scale * record.positions, velocities=np.float32(scale) * record.velocities)
    assert trust_of(larger, config).rate == pytest.approx(trust_of(record, config).rate, rel=1e-5)
    assert trust_of(larger, config).growth(1.0) == pytest.approx(scale * trust_of(record, config).growth(1.0), rel=1e-5)


@pytest.mark.parametrize("positions", [np.zeros((0, 3)), np.zeros((1, 3)), np.zeros((5, 3)), cloud() * [1.0, 1.0, 0.0]])
def test_smoke_without_a_size_is_trusted(positions: np.ndarray) -> None:
    trust = trust_of(visual(positions, np.tile(MOVING, (len(positions), 1))), ForecastConfig())
    assert trust.rate == 0.0
    assert trust.share_moved(1.0) == 1.0
    assert math.isfinite(trust.speed)
    assert trust_of(visual(positions, mass=0.0), ForecastConfig()).speed == 0.0


def test_deviations_grow_with_the_horizon() -> None:
    record = visual(cloud(), np.tile(MOVING, (120, 1)))
    found = forecast.deviations(record, ForecastConfig(num_frames=3), seconds=0.5)
    speed = float(np.linalg.norm(MOVING))
    np.testing.assert_allclose(found, DOUBT * speed * np.array([0.5, 1.0, 1.5]), rtol=1e-6)
    assert forecast.deviations(record, ForecastConfig(), seconds=0.5) == []


# -- where it goes -------------------------------------------------------------------------------------------------------


def test_recent_velocity_is_the_mean_of_the_last_frames() -> None:
    fluid = [physical(cloud(), speed * UP) for speed in (100.0, 1.0, 2.0, 4.0, 5.0)]
    assert RECENT == 4
    np.testing.assert_allclose(recent_velocity(cloud(9, seed=1), fluid, []), np.tile(3.0 * UP, (9, 1)), atol=1e-12)
    np.testing.assert_allclose(recent_velocity(cloud(9, seed=1), fluid[:1], []), np.tile(100.0 * UP, (9, 1)), atol=1e-12)
    assert recent_velocity(np.zeros((0, 3)), fluid, []).shape == (0, 3)


def test_volumes_have_half_a_say() -> None:
    fluid, guides = [physical(cloud(), 1.0 * UP)] * 5, [Guide(volume(np.array([2.0, 0.0, 3.0])))] * RECENT
    found = recent_velocity(cloud(9, seed=1), fluid, guides)
    np.testing.assert_allclose(found, np.tile([1.0, 0.0, 2.0], (9, 1)), atol=1e-6)
    np.testing.assert_allclose(recent_velocity(cloud(9, seed=1), fluid, []), np.tile(UP, (9, 1)), atol=1e-12)


def test_the_last_volumes_learn_from_the_pictures_how_their_rays_move() -> None:
    """Proposed is smoke that stands still, shown is smoke that rises; of one picture alone nothing is learned."""
    layers = clip(MOVING)[0]
    still = [volume(0.01 * UP)] * 5
    scene = make_scene(layers, CAMERAS)
    guides = recent_guides(still, layers, scene)
    assert len(guides) == RECENT
    at_smoke = np.array([guide.velocity_at(cloud(9, seed=1) + 0.3 * MOVING).mean(axis=0) for guide in guides])
    assert np.all(at_smoke[:, 2] > 0.1)
    alone = recent_guides(still[:1], layers[:1], make_scene(layers[:1], CAMERAS))
    np.testing.assert_array_equal(alone[0].velocity, Guide(still[0]).velocity)


def test_pure_motion_by_hand() -> None:
    records = run(clip(MOVING), PURE)
    start = cloud() + 4 / FPS * MOVING
    for step, record in enumerate(records, start=1):
        np.testing.assert_allclose(record.positions, start + step / FPS * MOVING, atol=1e-6)
        np.testing.assert_allclose(record.velocities, np.tile(MOVING, (120, 1)), atol=1e-6)
        np.testing.assert_array_equal(record.scales, np.float32(0.2))


def resting(velocity: np.ndarray, *, num_frames: int = 12) -> tuple[list[np.ndarray], list[PhysicalRecord], list[VisualRecord]]:
    """A cloud whose particles are said to move, and whose pictures stay as they are."""
    seen = [visual(cloud(), np.tile(velocity, (120, 1)))] * num_frames
    layers = [picture(particle_frame(record), VIEW) for record in seen]
    return layers, [physical(record.positions, velocity) for record in seen], seen


def test_motion_that_no_picture_bears_out_is_not_foretold() -> None:
    layers, fluid, seen = resting(MOVING)
    last = run((layers, fluid, seen), PURE)[-1]
    masses = last.optical_masses.astype(np.float64)
    at_rest = np.isin(last.ids, seen[-1].ids + seen[-1].next_id)
    assert masses[at_rest].sum() > 0.9 * masses.sum()
    foretold = squared_errors(picture(particle_frame(last), VIEW), layers[-1])[0]
    assert decibels(foretold) > 40.0


def confirmed(layers: list[np.ndarray], fluid: list[PhysicalRecord], seen: list[VisualRecord]) -> float:
    scene = make_scene(layers, CAMERAS)
    return forecast.confirmed(forecast.Known(scene=scene, layers=layers, fluid=fluid, seen=seen, volumes=None))


def test_motion_that_pictures_bear_out_is() -> None:
    parts = clip(MOVING, num_frames=12)
    assert confirmed(*parts) == 1.0
    half = [replace(record, velocities=0.25 * record.velocities) for record in parts[1]], parts[2]
    assert confirmed(parts[0], *half) == 1.0, "slower than it is, it is not less sure"
    fast = [replace(record, velocities=2.0 * record.velocities) for record in parts[1]], parts[2]
    assert 0.3 < confirmed(parts[0], *fast) < 0.9
    assert confirmed(*(part[:2] for part in parts)) == 1.0, "two frames tell nothing"


def test_before_a_camera_that_moves_it_is_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where smoke is wrong in depth its pictures change by that, too."""
    parts, asked = resting(MOVING), []
    monkeypatch.setattr(forecast, "confirmed", lambda known: asked.append(known) or 1.0)
    around = orbit_cameras(Orbit(target=(0.0, 0.0, 0.0), distance=10.0), width=48, height=64, fps=FPS, num_frames=12)
    list(forecast.run(parts[0], around, parts[1], parts[2], PURE, SilentReport()))
    assert not asked
    run(parts, PURE)
    assert len(asked) == 1


def test_moving_smoke_widens_and_a_share_stays() -> None:
    parts, config = clip(MOVING), ForecastConfig(num_frames=4, fading=0.4, spreading=0.25)
    trust = trust_of(parts[2][-1], config)
    for step, record in enumerate(run(parts, config), start=1):
        share, width = trust.share_moved(step / FPS), trust.growth(step / FPS)
        total = float(record.optical_masses.sum(dtype=np.float64))
        assert float(record.optical_masses[:120].sum(dtype=np.float64)) / total == pytest.approx(share, rel=1e-5)
        np.testing.assert_allclose(record.scales[:120], math.hypot(0.2, width), rtol=1e-6)
        np.testing.assert_array_equal(record.positions[120:], parts[2][-1].positions)
        assert not record.velocities[120:].any()


def test_all_smoke_rests_in_the_end() -> None:
    """Far ahead the forecast is the frozen last frame."""
    parts = clip(MOVING)
    last = run(parts, ForecastConfig(num_frames=60, fading=50.0))[-1]
    shown, frozen = (picture(particle_frame(record), VIEW) for record in (last, parts[2][-1]))
    assert decibels(squared_errors(shown, frozen)[0]) > 35.0


def test_it_is_better_than_freezing_where_smoke_flies_by() -> None:
    velocity = np.array([0.5, 0.0, 0.7])
    parts = clip(velocity, num_frames=9)
    fitted = tuple(part[:5] for part in parts)
    records = run(fitted, ForecastConfig(num_frames=4))
    for step, record in enumerate(records, start=1):
        truth = parts[0][4 + step]
        ahead = decibels(squared_errors(picture(particle_frame(record), VIEW), truth)[0])
        assert ahead > decibels(squared_errors(fitted[0][-1], truth)[0]) + 6.0


def test_what_leaves_the_picture_is_gone() -> None:
    records = run(clip(np.array([0.0, 0.0, 30.0]), num_frames=2), replace(PURE, num_frames=6))
    counts = [len(record.positions) for record in records]
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] == 0


def test_the_source_goes_on_emitting() -> None:
    layers, fluid, seen = clip(MOVING)
    foot = seen[-1].positions[:, 2].argmin()
    born = np.zeros(120, np.int32)
    born[foot] = 4
    seen[-1] = replace(seen[-1], born=born)
    records = run((layers, fluid, seen), PURE)
    assert [len(record.positions) for record in records] == [120, 120, 120, 121]  # of four frames only the last gave birth
    at_source = np.linalg.norm(records[-1].positions - seen[-1].positions[foot], axis=1)
    assert at_source.min() < 1e-9
    assert records[-1].velocities[at_source.argmin()] == pytest.approx(MOVING, abs=1e-6)


@pytest.mark.parametrize("config", [PURE, ForecastConfig(num_frames=4)])
def test_a_parcel_keeps_its_id(config: ForecastConfig) -> None:
    layers, fluid, seen = clip(MOVING)
    seen[-1] = replace(seen[-1], born=np.full(120, 4, np.int32))
    records = run((layers, fluid, seen), config)
    for record in records:
        assert len(np.unique(record.ids)) == len(record.ids)
        assert record.ids.max() < record.next_id
    for before, after in itertools.pairwise(records):
        _, was, now = np.intersect1d(before.ids, after.ids, return_indices=True)
        np.testing.assert_array_equal(before.colors[was], after.colors[now])
        way = np.linalg.norm(after.positions[now] - before.positions[was], axis=1)
        assert way.max() <= 1.01 * np.linalg.norm(MOVING) / FPS  # no id that jumps to another parcel


# -- clips with little in them ---------------------------------------------------------------------------------------------


class Untouchable:
    """A series that nobody may read."""

    def __len__(self) -> int:
        raise AssertionError("read")

    def __getitem__(self, index: int) -> np.ndarray:
        raise AssertionError("read")


@pytest.mark.parametrize("method", ["default", "fluidnexus"])
def test_no_frames_cost_nothing(method: str) -> None:
    nothing = Untouchable()
    assert run((nothing, nothing, nothing), ForecastConfig(), method=method) == []


def test_one_frame_and_no_smoke() -> None:
    layers, fluid, seen = clip(np.zeros(3), num_frames=1)
    for record in run((layers, fluid, seen), ForecastConfig(num_frames=2)):
        np.testing.assert_array_equal(record.positions[:120], seen[0].positions)
    empty = [np.zeros((64, 48, 4), np.float32)], [physical(np.zeros((0, 3)), MOVING)], [visual(np.zeros((0, 3)))]
    assert [len(record.positions) for record in run(empty, ForecastConfig(num_frames=2))] == [0, 0]
    assert [len(record.positions) for record in run(empty, ForecastConfig(num_frames=2), volumes=[])] == [0, 0]


def test_physical_particles_may_be_lacking() -> None:
    layers, _, seen = clip(MOVING)
    none = [physical(np.zeros((0, 3)), MOVING)] * 5
    for record in run((layers, none, seen), PURE):
        np.testing.assert_array_equal(record.positions, seen[-1].positions)


def test_equal_bytes_twice_and_a_cancel_is_heard() -> None:
    parts, config = clip(MOVING), ForecastConfig(num_frames=3)
    for first, second in zip(run(parts, config), run(parts, config), strict=True):
        for item in dataclasses.fields(first):
            assert np.asarray(getattr(first, item.name)).tobytes() == np.asarray(getattr(second, item.name)).tobytes()

    class Stops(SilentReport):
        def progress(self, step: int, total: int, **metrics: float) -> None:
            raise Cancelled

    with pytest.raises(Cancelled):
        next(forecast.run(parts[0], CAMERAS, parts[1], parts[2], config, Stops()))


def test_the_published_methods_keep_their_own() -> None:
    layers, fluid, seen = clip(MOVING)
    ours = run((layers, fluid, seen), ForecastConfig(num_frames=3), method="as_published")
    theirs = published_future.run(fluid, seen, PublishedConfig(), SilentReport(), num_frames=3, view=VIEW, seconds=1.0 / FPS)
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one.positions, other.positions)
        np.testing.assert_array_equal(one.optical_masses, other.optical_masses)
