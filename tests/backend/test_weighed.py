"""What is known of a frame is gathered where it belongs."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from backend.fit.levelled import Levels
from backend.fit.weighed import Weighing
from backend.prior.shares import ShareNet
from backend.prior.sheets import UNIT
from tests.backend.test_levels import SOURCE, Sure, leaning, middles, region, upright_column

FRAME = 30


def weighing(unsure: float = -6.0) -> Weighing:
    own = region(leaning())
    return Weighing(region=own, levels=Levels(own, Sure(unsure), stride=2), net=ShareNet())


def test_it_is_known_how_far_the_two_networks_are_apart() -> None:
    said = upright_column(9.0, finer=1.5)
    own = weighing()
    own.levels.weigh([(said, FRAME)])
    found = own.known(said, said.density, said.density, FRAME)
    aim = said.stand.voxels(SOURCE[None])[0, 1] + 1.5 * UNIT
    assert float(found.astray) == pytest.approx(abs(aim - middles(said.density)[30]), rel=0.02)
    assert 0.0 < own.levels.share <= 1.0


@pytest.mark.parametrize("finer", [1.0, 1.5])
def test_lengths_are_in_the_records_own_voxels(finer: float) -> None:
    said = upright_column(9.0, finer=finer)
    lasts = np.ones_like(said.density)
    found = weighing().known(said, 2 * said.density, lasts, FRAME)
    shape = said.density.shape
    assert found.middle.shape == (shape[0], shape[2])
    aim = said.stand.voxels(SOURCE[None])[0, 1] + finer * UNIT
    np.testing.assert_allclose(found.middle, aim, atol=1e-4)
    np.testing.assert_allclose(found.width, finer * UNIT * np.e, rtol=1e-5)
    np.testing.assert_allclose(found.unsure, finer * UNIT * np.exp(-6.0), rtol=1e-5)
    np.testing.assert_array_equal(found.said, said.density)
    np.testing.assert_array_equal(found.sharp, 2 * said.density)
    np.testing.assert_array_equal(found.lasts, lasts)
    levels = slice(round(8 * finer), round(28 * finer))
    np.testing.assert_allclose(middles(found.moved)[levels], aim, atol=0.2)


def test_the_frame_is_looked_up_where_each_voxel_is_seen() -> None:
    """The column leans to the camera's right at this frame: so do the voxels that see it."""
    own, said = weighing(), upright_column(9.0)
    found = own.known(said, said.density, said.density, FRAME)
    depth, view = own.region.finer.of(FRAME)
    for voxel in ([12, 9, 10], [14, 12, 25], [10, 4, 30]):
        point = said.stand.points(np.array(voxel, float)[None])
        (pixel, *_), _ = view.project(point)
        left, top = np.floor(pixel - 0.5).astype(int)
        around = depth[top : top + 2, left : left + 2]
        assert around.min() - 1e-6 <= found.depth[tuple(voxel)] <= around.max() + 1e-6
    assert found.depth.max() > 0.1


def test_untaught_it_changes_nothing() -> None:
    said = upright_column(9.0)
    np.testing.assert_array_equal(weighing().weighed(said, 3 * said.density, said.density, FRAME), 3 * said.density)


def test_it_counts_where_levels_stay_where_they_are() -> None:
    said, own = upright_column(9.0), weighing()
    torch.manual_seed(4)
    torch.nn.init.normal_(own.net.exit.weight, std=0.5)
    found = own.weighed(said, said.density, said.density, FRAME)
    own.levels.share = 0.0
    np.testing.assert_array_equal(own.weighed(said, said.density, said.density, FRAME), found)
    assert not np.allclose(found, said.density, rtol=0.01)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_any_number_of_threads_says_the_same(threads: int) -> None:
    said, own = upright_column(9.0), weighing()
    torch.manual_seed(4)
    for conv in (own.net.exit, own.net.around):
        torch.nn.init.normal_(conv.weight, std=0.5)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        found = own.weighed(said, said.density, said.density, FRAME)
        assert torch.get_num_threads() == threads
        torch.set_num_threads(1)
        assert found.tobytes() == own.weighed(said, said.density, said.density, FRAME).tobytes()
    finally:
        torch.set_num_threads(before)
    assert found.tobytes() != said.density.tobytes()
