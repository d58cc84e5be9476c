"""The published methods: each loss by hand and by differences, what buoyancy can and cannot see, whole fits of a tiny clip."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from backend.contract.cameras import Cameras
from backend.contract.job import PublishedConfig
from backend.fit import losses
from backend.fit.carry import as_fluid
from backend.fit.scene import make_scene
from backend.fit.state import particle_frame
from backend.fit.supply import make_supply
from backend.physics.fluid import FluidParameters, FluidState, derive_parameters, step
from backend.physics.fluid_gradient import rollout
from backend.published import future, particle_losses, physical, visual
from backend.published.pictures import coded_target, linear_picture_loss, picture_loss
from backend.render.picture import picture
from backend.reporting import SilentReport

SMALL = PublishedConfig(num_physical=80, num_particles=150, physical_iterations=3, visual_iterations=4, first_frame_factor=2)
CAMERAS = Cameras(
    width=36, height=48, fx=60.0, fy=60.0, cx=18.0, cy=24.0, fps=12.0,
    camera_to_world=(((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -10.0), (0.0, -1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),),
)  # fmt: skip


def tiny_clip(num_frames: int = 5) -> list[np.ndarray]:
    """[H, W, 4] layers of a puff that rises by two px a frame."""
    y, x = np.mgrid[0:48, 0:36] + 0.5
    layers = []
    for frame in range(num_frames):
        opacity = 1.0 - np.exp(-1.5 * np.exp(-((x - 18.0) ** 2 + (y - 34.0 + 2.0 * frame) ** 2) / (2.0 * 5.0**2)))
        opacity[opacity < 0.03] = 0.0
        color = opacity[..., None] * np.array([0.5, 0.45, 0.4])
        layers.append(np.concatenate([color, opacity[..., None]], axis=2).astype(np.float32))
    return layers


def cloud(num=60, *, squeeze=1.0, seed=0):
    random = np.random.default_rng(seed)
    return FluidState(
        positions=squeeze * random.random((num, 3)),
        velocities=0.2 * random.normal(size=(num, 3)),
        masses=np.ones(num),
        ids=np.arange(num),
        born=np.zeros(num, np.int32),
    )


def fluid_for_clouds(**options) -> FluidParameters:
    return replace(derive_parameters(np.random.default_rng(1).random((200, 3))), **options)


def assert_slope(loss, gradient, values, *, rel=1e-4, step_size=1e-6, seed=3):
    """The gradient along a random direction against a central difference."""
    along = np.random.default_rng(seed).normal(size=values.shape)
    measured = (loss(values + step_size * along) - loss(values - step_size * along)) / (2.0 * step_size)
    assert measured == pytest.approx(float((gradient * along).sum()), rel=rel, abs=1e-9)


# -- pictures ------------------------------------------------------------------------------------------------------------


def pictures(channels=3):
    layer = tiny_clip(2)
    target = coded_target(layer[0])[:channels]
    shown = np.moveaxis(layer[1][..., :channels], -1, 0).astype(np.float64) + 0.0
    return shown, target


def test_a_cut_picture_has_the_loss_of_the_whole():
    shown, target = pictures()
    whole, slope = losses.reconstruction(shown, target)
    cut, cut_slope = picture_loss(shown, target)
    assert cut == pytest.approx(whole, rel=1e-12)
    is_used = (shown > 0) | (target > 0)
    np.testing.assert_allclose(cut_slope[is_used], slope[is_used], atol=1e-15)


def test_equal_and_black_pictures_cost_nothing():
    _, target = pictures()
    assert picture_loss(target, target)[0] == pytest.approx(0.0, abs=1e-12)
    loss, slope = picture_loss(np.zeros((3, 20, 20)), np.zeros((3, 20, 20)), frequency=0.001)
    assert loss == 0.0 and not slope.any()


@pytest.mark.parametrize("frequency", [0.0, 0.001])
def test_slope_of_the_coded_picture(frequency):
    """Away from black, where L1 and the transfer function are smooth; the spectrum's bins are all far from empty."""
    random = np.random.default_rng(0)
    shown, target = 0.1 + 0.8 * random.random((3, 20, 24)), random.random((3, 20, 24))
    _, slope = linear_picture_loss(shown, target, frequency=frequency)
    assert_slope(lambda x: linear_picture_loss(x, target, frequency=frequency)[0], slope, shown, step_size=1e-7, rel=1e-3)


# -- particles -----------------------------------------------------------------------------------------------------------


def test_anchor_and_spacing_by_hand():
    """Two particles a half spacing apart: (1 - 1/2)^2 each; one of them a smoothing length from where it should be: 1 / 2."""
    length = particle_losses.SPACINGS_PER_LENGTH
    positions = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    loss, slope = particle_losses.spacing_loss(positions, length)
    assert loss == pytest.approx(0.25)
    np.testing.assert_allclose(slope, [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], atol=1e-12)
    loss, _ = particle_losses.anchor_loss(positions, positions + length * np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]), length)
    assert loss == pytest.approx(0.5)


def test_slopes_on_particles():
    parameters, state = fluid_for_clouds(), cloud(squeeze=0.5)
    x, length = state.positions, parameters.smoothing_length
    for loss in (
        lambda x: particle_losses.anchor_loss(x, x[::-1].copy() * 0 + 0.3, length),
        lambda x: particle_losses.spacing_loss(x, length),
        lambda x: particle_losses.density_loss(x, parameters),
        lambda x: particle_losses.ahead_loss(x, replace(state, positions=state.positions - 0.01), parameters, 0.05)[:2],
    ):
        value, slope = loss(x)
        assert value > 0.0
        assert_slope(lambda x, loss=loss: loss(x)[0], slope, x, rel=2e-4)


@pytest.mark.parametrize("num", [0, 1, 2])
def test_few_and_coincident_particles_are_finite(num):
    parameters, state = fluid_for_clouds(), cloud(num)
    state = replace(state, positions=np.zeros((num, 3)))
    found = [
        particle_losses.anchor_loss(state.positions, state.positions, 1.0),
        particle_losses.spacing_loss(state.positions, 1.0),
        particle_losses.density_loss(state.positions, parameters),
        particle_losses.ahead_loss(state.positions, state, parameters, 0.05)[:2],
    ]
    for loss, slope in found:
        assert np.isfinite(loss) and np.isfinite(slope).all() and slope.shape == (num, 3)


def test_density_one_step_ahead_does_not_see_buoyancy():
    """As published it has no gradient: density is the same when all move alike. The anchor's prediction does move."""
    parameters, before = fluid_for_clouds(buoyancy=(0.0, 0.0, 2.0)), cloud(squeeze=0.3)
    now = before.positions + 0.002 * np.random.default_rng(2).normal(size=(60, 3))
    loss, by_position, by_buoyancy = particle_losses.ahead_loss(now, before, parameters, 0.05)
    assert loss > 0.0 and np.abs(by_position).max() > 1e-3
    np.testing.assert_allclose(by_buoyancy, 0.0, atol=1e-13)
    ahead = rollout(before, parameters, 0.05)
    _, slope = particle_losses.anchor_loss(now + 0.1, ahead.states[1].positions, parameters.smoothing_length)
    assert ahead.backward([None, -slope]).buoyancy[2] < -1e-6


def test_buoyancy_is_found_through_the_anchor():
    """Positions that another buoyancy would have led to: one frame tells it, half the say is left to the ridge."""
    layers = tiny_clip()
    scene = make_scene(layers, CAMERAS)
    supply = make_supply(scene, layers, SMALL.num_physical, seed=0)
    config = replace(SMALL, surface_drag=0.0, viscosity=0.0)
    fit = physical._Fit(supply, config, learns_buoyancy=True)
    record = replace(supply.with_births(supply.empty(), 0), buoyancy=config.buoyancy * physical.UP)
    wanted, _ = step(as_fluid(record), replace(physical.fluid_of(record, config), buoyancy=(0.0, 0.0, 1.4)), 1.0 / 12.0)
    moved = rollout(as_fluid(record), physical.fluid_of(record, config), 1.0 / 12.0)
    learned = fit._learned(record, wanted.positions, moved, as_fluid(record))
    assert learned.buoyancy_moment[2] == pytest.approx(1.4, abs=1e-6)
    ridge = physical.BUOYANCY_RIDGE
    assert learned.buoyancy[2] == pytest.approx((1.4 + ridge * config.buoyancy) / (1.0 + ridge), abs=1e-6)


# -- looks ---------------------------------------------------------------------------------------------------------------


def variables(num, seed):
    random = np.random.default_rng(seed)
    return visual._Variables(
        log_masses=random.normal(size=num),
        log_scales=0.3 * random.normal(size=(num, 3)),
        rotations=random.normal(size=(num, 4)),
        colors=random.random((num, 3)),
    )


def test_consistency_holds_those_that_were_there():
    now, before = variables(7, 0), variables(5, 1)
    loss, slope = visual.consistency(now, before)
    expected = (
        10.0 * np.square(now.colors[:5] - before.colors).mean() + 0.1 * np.square(now.rotations[:5] - before.rotations).mean()
    )
    expected += 8.0 * np.square(now.opacities()[:5] - before.opacities()).mean()
    assert loss == pytest.approx(expected)
    for field in dataclasses.fields(now):
        gradient = getattr(slope, field.name)
        assert not gradient[5:].any()

        def changed(values, name=field.name):
            return visual.consistency(replace(now, **{name: values}), before)[0]

        assert_slope(changed, gradient, getattr(now, field.name))
    assert visual.consistency(now, variables(0, 1))[0] == 0.0


def test_a_frame_begins_with_everyone_as_before(monkeypatch):
    """Also where the faintest, anywhere among the others, made room for newborn ones."""
    layers = tiny_clip(2)
    scene = make_scene(layers, CAMERAS)
    look = visual._Look(scene, layers, replace(SMALL, num_particles=60), True, 0)
    record = look.fitted(look.empty(), 0)
    masses = record.optical_masses * np.where(np.arange(len(record.ids)) % 9 == 4, 0.06, 0.9).astype(np.float32)
    colors = np.random.default_rng(0).random((len(masses), 3)).astype(np.float32)
    found, consistency = [], visual.consistency
    monkeypatch.setattr(visual, "consistency", lambda now, before: found.append((now, before)) or consistency(now, before))
    look.fitted(replace(record, optical_masses=masses, colors=colors), 1)
    now, before = found[0]
    assert 0 < len(before.log_masses) < len(record.ids) < len(now.log_masses)
    assert consistency(now, before)[0] == 0.0


# -- whole fits ----------------------------------------------------------------------------------------------------------


def fitted(layers, config=SMALL, *, is_wildsmoke=True, done=((), ())):
    """Physical and visual records of all frames; `done` of the first ones."""
    moves = list(done[0])
    kind = {"seed": 0, "done": tuple(done[0])}
    moves += physical.run(layers, CAMERAS, config, SilentReport(), learns_buoyancy=is_wildsmoke, **kind)
    looks = list(done[1])
    kind = {"seed": 0, "done": tuple(done[1])}
    looks += visual.run(layers, CAMERAS, moves, config, SilentReport(), has_frequency_loss=is_wildsmoke, **kind)
    return moves, looks


def same(a, b):
    return all(
        np.asarray(getattr(a, f.name)).tobytes() == np.asarray(getattr(b, f.name)).tobytes() for f in dataclasses.fields(a)
    )


def picture_error(looks, layers):
    view = make_scene(layers, CAMERAS).views[0]
    errors = [np.square(picture(particle_frame(look), view) - layer).mean() for look, layer in zip(looks, layers, strict=True)]
    return float(np.mean(errors))


@pytest.mark.parametrize("is_wildsmoke", [True, False])
def test_a_fit_looks_like_its_clip_and_resumes_to_the_same_bytes(is_wildsmoke):
    layers = tiny_clip()
    moves, looks = fitted(layers, is_wildsmoke=is_wildsmoke)
    resumed = fitted(layers, is_wildsmoke=is_wildsmoke, done=(moves[:2], looks[:3]))
    assert all(same(a, b) for a, b in zip((*moves, *looks), (*resumed[0], *resumed[1]), strict=True))
    black = float(np.mean([np.square(layer).mean() for layer in layers]))
    assert picture_error(looks, layers) < 0.05 * black
    assert (moves[-1].buoyancy[2] == SMALL.buoyancy) != is_wildsmoke
    rising = moves[-1].velocities.mean(axis=0)  # 2 px a frame at 10 m: 0.33 m, 4 m/s
    assert rising[2] > 1.0 and abs(rising[0]) < 0.5 * rising[2]


def test_more_iterations_lower_the_losses():
    layers = tiny_clip(2)
    losses_found, fits = [], []
    for iterations in (1, 12):
        config = replace(SMALL, visual_iterations=iterations)
        look = visual._Look(make_scene(layers, CAMERAS), layers, replace(config, first_frame_factor=1), True, 0)
        look.fitted(look.empty(), 0)
        losses_found.append(look.loss)
        fits.append(fitted(layers, config))
    assert losses_found[1] < 0.7 * losses_found[0]
    (moves, few), (_, many) = fits
    assert picture_error(many, layers) < picture_error(few, layers)  # by how much is open: no loss is that squared error
    supply = make_supply(make_scene(layers, CAMERAS), layers, SMALL.num_physical, seed=0)
    losses_found = []
    for iterations in (0, 8):
        fit = physical._Fit(supply, replace(SMALL, physical_iterations=iterations), learns_buoyancy=False)
        fit.advance(moves[0], 1)
        losses_found.append(fit.loss)
    assert losses_found[1] < losses_found[0]


def test_particles_stay_within_their_limits():
    _, looks = fitted(tiny_clip(2))
    for look in looks:
        assert look.rotations is not None and look.scales.shape == (len(look.ids), 3)
        assert (look.scales.max(axis=1) <= visual.MAX_ASPECT * look.scales.min(axis=1) * (1.0 + 1e-5)).all()
        np.testing.assert_allclose(np.linalg.norm(look.rotations, axis=1), 1.0, atol=1e-5)
        assert (visual._Variables.of(look).opacities() <= visual.MAX_OPACITY + 1e-5).all()
        assert len(np.unique(look.ids)) == len(look.ids) <= SMALL.num_particles


def test_a_clip_without_smoke_gives_empty_records():
    layers = [np.zeros((48, 36, 4), np.float32) for _ in range(2)]
    layers.append(tiny_clip(1)[0])
    moves, looks = fitted(layers)
    assert [len(look.ids) for look in looks[:2]] == [0, 0] and len(looks[2].ids) > 0
    assert looks[0].rotations is not None and looks[0].rotations.shape == (0, 4)
    assert moves[2].buoyancy[2] == SMALL.buoyancy


def test_the_future_goes_on_without_the_clip():
    layers = tiny_clip()
    moves, looks = fitted(layers)
    view = make_scene(layers, CAMERAS).views[-1]
    ahead = list(future.run(moves, looks, SMALL, SilentReport(), num_frames=3, view=view, seconds=1.0 / 12.0))
    assert len(ahead) == 3
    heights = [look.positions[np.isin(look.ids, looks[-1].ids), 2].mean() for look in (looks[-1], *ahead)]
    assert heights == sorted(heights) and heights[-1] > heights[0] + 0.2
    for look in ahead:
        assert np.isfinite(look.positions).all() and len(np.unique(look.ids)) == len(look.ids)
