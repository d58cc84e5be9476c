"""Random plumes, and their library."""

from __future__ import annotations

import numpy as np
import pytest

from training.level_lessons import draw_clip
from training.library import NUM_FRAMES, VELOCITY_EVERY, VOXEL_SIZE, Plume, main, read_plume
from training.plumes import SIZE, plume
from training.samples import lattice_of, smoke_of

_COARSE = 1.0  # m


@pytest.fixture(scope="module")
def coarse(tmp_path_factory: pytest.TempPathFactory) -> Plume:
    folder = tmp_path_factory.mktemp("library")
    assert main(["--out", str(folder), "--seeds", "3:4", "--voxel-size", str(_COARSE)]) == 0
    return read_plume(folder / "0003")


def test_a_library_says_how_large_its_voxels_are(coarse: Plume) -> None:
    assert coarse.voxel_size == _COARSE
    assert coarse.density.shape == (NUM_FRAMES, *(round(size / _COARSE) for size in SIZE))
    assert len(coarse.velocity) == len(range(0, NUM_FRAMES, VELOCITY_EVERY))
    assert coarse.density_at(NUM_FRAMES - 1).max() > 0.1
    np.testing.assert_allclose([np.ptp(axis) + _COARSE for axis in lattice_of(coarse).axes()], SIZE)


def test_what_is_known_of_smoke_is_in_metres(recorded: Plume) -> None:
    """Whatever the voxels: the same smoke with two voxels of eight made one."""
    halves = recorded.density.astype(np.float32).reshape(NUM_FRAMES, 18, 2, 18, 2, 30, 2).mean(axis=(2, 4, 6))
    coarser = Plume(
        scene=recorded.scene,
        density=np.rint(halves).astype(np.uint8),
        velocity=recorded.velocity[:, ::2, ::2, ::2],
        origin=tuple(edge + 0.5 * VOXEL_SIZE for edge in recorded.origin),  # type: ignore[arg-type]
        voxel_size=2 * VOXEL_SIZE,
    )
    ours, theirs = smoke_of(coarser, 0, NUM_FRAMES), smoke_of(recorded, 0, NUM_FRAMES)
    np.testing.assert_allclose(ours.middle, theirs.middle, atol=0.1)
    assert abs(ours.top - theirs.top) <= 2 * VOXEL_SIZE
    assert abs(ours.cell - theirs.cell) <= 0.1 * theirs.cell
    a, b = (draw_clip(each, np.random.default_rng(1)) for each in (coarser, recorded))
    assert a is not None and b is not None
    mass = np.square(b["mass"] / 255.0)
    off = np.abs(a["middle"].astype(float) - b["middle"])[mass > 0.2 * mass.max()]
    assert np.median(off) < 0.1, "units of five voxels"


def test_later_plumes_have_more_sources_that_light_up_while_they_are_filmed() -> None:
    def shares(first: int) -> tuple[float, float]:
        scenes = [plume(seed) for seed in range(first, first + 150)]
        late = [source.start > scene.warm_up for scene in scenes for source in scene.sources]
        return float(np.mean([len(scene.sources) > 1 for scene in scenes])), float(np.mean(late))

    (few, early), (many, late) = shares(300), shares(700)
    assert 0.25 < few < 0.45 < many < 0.65
    assert late > 1.3 * early


def test_a_number_means_the_same_plume() -> None:
    assert plume(305) == plume(305) != plume(306)
