"""Accuracy may not fall and work may not grow unnoticed: two small jobs against the last entry of docs/results/guard.json.

Where one of the first two tests fails and that is as it should be: `python -m benchmarks.guard --add "Reason."`.
"""

from __future__ import annotations

import copy
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from backend.contract.errors import BackendError
from backend.estimate import machine
from backend.io.particles import ParticleFrame
from backend.physics import neighbours
from backend.physics import solver as solvers
from backend.render import picture, splat, voxelize
from benchmarks import guard, work

BASELINE = guard.history()[-1]["cases"] if guard.HISTORY.is_file() else {}
PRIOR, NO_PRIOR = guard.CASES


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the pictures that all jobs are scored on."""
    return tmp_path_factory.mktemp("guard")


@pytest.mark.parametrize("case", list(guard.CASES))
def test_nothing_got_worse_or_dearer(case: str, folder: Path) -> None:
    found = guard.measure(guard.CASES[case], folder)
    idle = {"prior_operations"} if case == NO_PRIOR else set()
    assert {kind for kind, count in found["work"].items() if count == 0} == idle, "a kind of work that is not seen is not guarded"
    assert list(guard.complaints({case: found}, BASELINE)) == []


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"visual.iterations": 0}, {"input_smoke_db"}),
        ({"visual.iterations": 8}, {"splat_cells"}),
        ({"physical.solver_iterations": 5}, {"neighbour_visits"}),
    ],
)
def test_what_is_made_worse_or_dearer_is_noticed(changes: dict[str, int], expected: set[str], folder: Path) -> None:
    found = guard.measure({**guard.CASES[NO_PRIOR], **changes}, folder)
    said = " ".join(guard.complaints({NO_PRIOR: found}, BASELINE))
    assert all(f" {name} " in said for name in expected), said
    assert ("input_smoke_db fell" in said) is ("input_smoke_db" in expected)


def test_the_limits_by_hand() -> None:
    before = copy.deepcopy(BASELINE)
    for fallen, is_noticed in ((0.29, False), (0.31, True)):
        after = copy.deepcopy(before)
        after[PRIOR]["scores"]["side_db"] -= fallen
        assert bool(list(guard.complaints(after, before))) is is_noticed
    for risen, is_noticed in ((1.14, False), (1.16, True)):
        after = copy.deepcopy(before)
        after[PRIOR]["work"]["prior_operations"] *= risen
        assert bool(list(guard.complaints(after, before))) is is_noticed
    after = copy.deepcopy(before)
    del after[PRIOR]["scores"]["density_correlation"]
    assert "density_correlation fell" in next(guard.complaints(after, before)), "a score that is gone is no score"
    after[PRIOR]["scores"]["density_correlation"] = 1.0
    after[PRIOR]["work"] = dict.fromkeys(work.KINDS, 0)
    assert list(guard.complaints(after, before)) == [], "better and cheaper is no complaint"


def test_an_entry_needs_a_reason_and_keeps_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "HISTORY", tmp_path / "guard.json")
    monkeypatch.setattr(guard, "measure", lambda changes, folder: {"scores": {"nvs_db": 1.0}, "work": {"splat_cells": 5}})
    assert guard.main([]) == 1, "nothing to compare with"
    assert guard.main(["--add", "because"]) == 2 and not guard.HISTORY.exists()
    with pytest.raises(BackendError, match="does not say why"):
        guard.check_reason("It is faster")
    assert guard.main(["--add", "This is the first of them."]) == 0
    assert guard.main(["--add", "It stands as it stood before."]) == 0
    assert [entry["reason"] for entry in guard.history()] == ["This is the first of them.", "It stands as it stood before."]
    assert len(guard.HISTORY.read_text().splitlines()) == 4, "a line for each entry"


def test_the_history_is_whole() -> None:
    text = guard.HISTORY.read_text(encoding="utf-8")
    entries: list[dict[str, Any]] = json.loads(text, parse_constant=pytest.fail)
    assert text == guard.as_text(entries) and entries
    for entry in entries:
        guard.check_reason(entry["reason"])
        assert entry["cases"].keys() == guard.CASES.keys()
        for case in entry["cases"].values():
            assert set(work.KINDS) == case["work"].keys()
    for before, after in pairwise(entries):
        for name, case in before["cases"].items():
            guarded = case["scores"].keys() & guard.LARGEST_FALL.keys()
            assert guarded <= after["cases"][name]["scores"].keys(), "what was guarded once stays so"
    assert all(guard.LARGEST_FALL.keys() <= case["scores"].keys() for case in entries[-1]["cases"].values())


def test_counts_by_hand() -> None:
    """Three particles within one radius: six directed pairs; one Gaussian: the cells of its box."""
    positions = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])
    with work.counted() as counts:
        solvers.find_neighbours(positions, 1.0)  # where it was imported to
        assert counts["neighbour_visits"] == 6 and counts["kernel_elements"] > positions.size
        before = dict(counts)
    neighbours.find_neighbours(positions, 1.0)
    assert counts == before, "nothing is counted afterwards"


def test_drawing_and_filling_are_counted() -> None:
    from tiny_bench import LATTICE, cameras, puffs

    from backend.geometry.camera import view_at

    frame, view = puffs(0, 0.0, count=1), view_at(cameras("nvs"), 0)
    assert isinstance(frame, ParticleFrame)
    with work.counted() as counts:
        drawn = splat.forward(picture.isotropic(frame.positions, frame.scales, frame.optical_masses, frame.colors), view)
        first, last, left, right = drawn.geometry.boxes[0]
        cells = (last - first + 1) * (right - left + 1)
        assert counts["splat_cells"] == cells > 50
        splat.reweighted(drawn, 2.0 * frame.optical_masses)
        splat.backward(drawn, np.ones_like(drawn.image))
        splat.adjoint_mass(drawn, np.ones_like(drawn.image[0]))
        assert counts["splat_cells"] == 4 * cells
        voxelize.voxelize(frame, LATTICE)
        reach = 2.0 * voxelize.splat_extents(frame, LATTICE.voxel_size)[0] / LATTICE.voxel_size + 1.0
        assert counts["voxels_filled"] == round(float(reach.prod())) > 8


def test_timing_the_machine_is_no_work_of_a_job(tmp_path: Path) -> None:
    with work.counted() as counts:
        found = machine.this_machine(["splat"], folder=tmp_path)
        assert min(found.seconds.values()) > 0.0 and not any(counts.values())
        neighbours.find_neighbours(np.zeros((2, 3)), 1.0)
        assert counts["neighbour_visits"] == 2, "it goes on behind"


def test_the_backend_is_left_as_it_was() -> None:
    before = splat.forward, solvers.Solver.correct, work.Prior.propose, solvers.find_neighbours

    def fail_halfway() -> None:
        with work.counted():
            assert splat.forward is not before[0] and solvers.find_neighbours is not before[3]
            raise RuntimeError("halfway")

    with pytest.raises(RuntimeError, match="halfway"):
        fail_halfway()
    assert (splat.forward, solvers.Solver.correct, work.Prior.propose, solvers.find_neighbours) == before
