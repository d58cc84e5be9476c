"""Densities of single frames, which ours is to better: as deep as they are wide, and as dense as the frame shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from backend.field.rays import optical_depth
from backend.fit.guide import Guide
from backend.fit.scene import Scene
from backend.geometry.camera import view_at
from backend.score.measures import correlation
from backend.score.truth_set import Volume
from benchmarks.per_frame import CrossSections, main, own_words
from synthetic.sweep import Orbit, orbit_cameras

CAMERAS = orbit_cameras(Orbit(target=(0.0, 0.0, 3.0), half_height=2.5), width=72, height=96, fps=15.0, num_frames=4)
ANCHOR = np.array([0.0, 0.0, 3.0])


def puff(wide: float, deep: float) -> Volume:
    """Before the camera of the first frame."""
    voxel, shape = 0.1, (48, 48, 48)
    origin = ANCHOR - 0.5 * voxel * (np.array(shape) - 1)
    nothing = Volume(density=np.zeros(shape, np.float32), velocity=None, voxel_size=voxel, origin=origin)
    away = view_at(CAMERAS, 0).camera_to_world[:3, 2] * (1.0, 1.0, 0.0)
    away /= np.linalg.norm(away)
    off = nothing.lattice.centres() - ANCHOR
    along = off @ away
    across = np.square(off).sum(axis=-1) - np.square(along)
    density = 2.0 * np.maximum(1 - across / wide**2 - np.square(along / deep), 0.0) ** 1.5
    return Volume(density=density.astype(np.float32), velocity=None, voxel_size=voxel, origin=origin)


@pytest.mark.parametrize(("deep", "least", "most"), [(1.2, 0.97, 1.0), (0.4, 0.5, 0.9)])
def test_round_smoke_is_found_and_flat_smoke_taken_for_round(deep: float, least: float, most: float) -> None:
    real = puff(1.2, deep)
    views = tuple(view_at(CAMERAS, frame) for frame in range(4))
    opacity = -np.expm1(-optical_depth(real.density, real.lattice, views[0]))
    layer = np.repeat(opacity[..., None], 4, axis=2)
    scene = Scene(views=views, seconds_per_frame=1 / 15, anchor=ANCHOR)
    found, velocity = CrossSections([layer] * 4, scene).volume(real, 0)  # type: ignore[arg-type]
    assert least < correlation(found, real.density) <= most
    assert found.sum() == pytest.approx(real.density.sum(), rel=0.05)
    assert not velocity.any()


def test_the_network_alone_says_smoke_that_shows_what_the_frames_show() -> None:
    real, views = puff(1.2, 1.2), [view_at(CAMERAS, frame) for frame in range(4)]
    opacities = [-np.expm1(-optical_depth(real.density, real.lattice, view)) for view in views]
    records = own_words([np.repeat(opacity[..., None], 4, axis=2) for opacity in opacities], CAMERAS, name="puff")  # type: ignore[arg-type]
    assert len(records) == 4
    for record, view, opacity in zip(records, views, opacities, strict=True):
        said = Guide(record)
        shown = -np.expm1(-optical_depth(said.density, said.stand.lattice, said.stand.seen(view)))
        assert correlation(shown, opacity) > 0.98


def test_a_folder_without_jobs_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--jobs", str(tmp_path)])
    assert "run benchmarks.reconstruction first" in capsys.readouterr().err
