"""A recorded simulation: resumes to the same bytes, refuses another run's folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from backend.contract.errors import BackendError
from synthetic.scenes import SmokeScene, Source
from synthetic.solver import recording as module
from synthetic.solver.recording import Recording, record


def small(**changes: object) -> Recording:
    source = Source(position=(0.0, 0.0, 0.8), radius=0.6)
    scene = SmokeScene(name="small", purpose="a test", sources=(source,), size=(3.0, 3.0, 4.0), warm_up=0.1)
    values = {"scene": scene, "num_frames": 5, "fps": 10.0, "voxel_size": 0.3, "velocity_every": 2, **changes}
    return Recording(**values)  # type: ignore[arg-type]


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.vdb"))}


class Killed(BaseException):
    pass


@pytest.mark.parametrize("dies_after", [1, 3, 4])
def test_a_broken_run_ends_with_the_same_bytes(dies_after: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CHECKPOINT_SECONDS", 0.0)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    record(small(), whole, progress=lambda: None)
    count = 0

    def die() -> None:
        nonlocal count
        count += 1
        if count == dies_after:
            raise Killed

    with pytest.raises(Killed):
        record(small(), broken, progress=die)
    assert len(files(broken)) == dies_after
    record(small(), broken, progress=lambda: None)
    assert len(files(whole)) == 5
    assert files(broken) == files(whole)


def test_every_frame_is_counted_once_and_a_finished_run_is_left_alone(tmp_path: Path) -> None:
    for _ in range(2):
        calls: list[None] = []
        record(small(), tmp_path, progress=lambda calls=calls: calls.append(None))
        assert len(calls) == 5


def test_another_run_in_the_folder_is_refused(tmp_path: Path) -> None:
    record(small(num_frames=1), tmp_path, progress=lambda: None)
    with pytest.raises(BackendError, match="another simulation"):
        record(small(num_frames=1, voxel_size=0.4), tmp_path, progress=lambda: None)


def test_settings_and_units_are_written_down(tmp_path: Path) -> None:
    record(small(num_frames=1), tmp_path, progress=lambda: None)
    data = json.loads((tmp_path / "smoke.json").read_text(), parse_constant=pytest.fail)
    assert data["units"]["density"] == "1/m"
    assert data["scene"]["sources"][0]["stop"] is None
    assert data["voxel_size"] == 0.3
