"""VDB files: every voxel where it belongs, equal bytes for equal input, whole or absent, and written by another Python
where this one has no OpenVDB.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from backend.contract.errors import BackendError
from backend.io import openvdb_file, vdb

CHECKOUT = Path(vdb.__file__).resolve().parents[2]
OTHER_PYTHONS = [CHECKOUT / ".venv" / name / "bin" / "python" for name in ("blender", "blender52")]
PLACE = {"voxel_size": 0.25, "origin": (1.0, -2.0, 3.0)}

if vdb.openvdb_module() is None:
    pytest.skip("no OpenVDB module for this Python", allow_module_level=True)


@pytest.fixture
def no_module(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(vdb, "openvdb_module", lambda: None)
    monkeypatch.delenv(vdb.PYTHON_VARIABLE, raising=False)
    return


def sample_grids() -> dict[str, np.ndarray]:
    chance = np.random.default_rng(0)
    density = np.zeros((12, 20, 9), np.float32)
    density[3:7, 5:14, 2:6] = chance.random((4, 9, 4)) + 0.1
    velocity = np.where(density[..., None] > 0, chance.normal(size=(12, 20, 9, 3)), 0.0)
    return {"density": density, "velocity": velocity}


def read(path: Path, name: str, shape: tuple[int, ...]) -> tuple[np.ndarray, dict, tuple[float, ...]]:
    """Dense values from (0, 0, 0) on, facts, and the world position of voxel (1, 2, 3)."""
    module = vdb.openvdb_module()
    assert module is not None
    grid = module.read(str(path), name)
    dense = np.zeros(shape, np.float32)
    grid.copyToArray(dense)
    box = grid.evalActiveVoxelBoundingBox()
    facts = {"half": grid.saveFloatAsHalf, "class": str(grid.gridClass), "box": box, "active": grid.activeVoxelCount()}
    world = tuple(grid.transform.indexToWorld((1, 2, 3)))
    del grid
    return dense, facts, world


def test_voxels_and_transform(tmp_path: Path) -> None:
    grids = sample_grids()
    vdb.write_vdb(tmp_path / "a.vdb", grids, **PLACE)
    for name, expected in grids.items():
        values, facts, world = read(tmp_path / "a.vdb", name, expected.shape)
        np.testing.assert_allclose(values, expected, rtol=1e-3, atol=1e-6)  # float16 has 11 bits
        assert facts["box"] == ((3, 5, 2), (6, 13, 5))  # cropped to what is not zero
        assert facts["half"]
        assert world == pytest.approx((1.25, -1.5, 3.75))
    assert "FOG" in read(tmp_path / "a.vdb", "density", grids["density"].shape)[1]["class"].upper()


def test_views_with_strides_arrive_as_they_look(tmp_path: Path) -> None:
    values = np.random.default_rng(1).random((5, 6, 7)).astype(np.float32)
    for number, view in enumerate((values.T, values[::-1], values[:, ::2], np.asfortranarray(values), values.astype(np.float64))):
        path = tmp_path / f"{number}.vdb"
        vdb.write_vdb(path, {"density": view}, **PLACE)
        np.testing.assert_allclose(read(path, "density", view.shape)[0], view, rtol=1e-3)


def test_float32_is_kept_where_float16_would_not_do(tmp_path: Path) -> None:
    for peak in (1e-4, 1e5):
        values = np.random.default_rng(2).random((4, 4, 4)) * peak
        vdb.write_vdb(tmp_path / "a.vdb", {"density": values}, **PLACE)
        found, facts, _ = read(tmp_path / "a.vdb", "density", values.shape)
        np.testing.assert_allclose(found, values, rtol=1e-6)
        assert not facts["half"]


@pytest.mark.parametrize("shape", [(0, 0, 0), (1, 1, 1), (8, 8, 8)])
def test_an_empty_frame_is_a_file_with_empty_grids(tmp_path: Path, shape: tuple[int, int, int]) -> None:
    vdb.write_vdb(tmp_path / "a.vdb", {"density": np.zeros(shape), "velocity": np.zeros((*shape, 3))}, **PLACE)
    for name, tail in (("density", ()), ("velocity", (3,))):
        _, facts, world = read(tmp_path / "a.vdb", name, (2, 2, 2, *tail))
        assert facts["active"] == 0
        assert world == pytest.approx((1.25, -1.5, 3.75))


def test_equal_input_gives_equal_bytes_other_input_another_identity(tmp_path: Path) -> None:
    grids = sample_grids()
    for name in ("a", "b"):
        vdb.write_vdb(tmp_path / f"{name}.vdb", grids, **PLACE)
    a = (tmp_path / "a.vdb").read_bytes()
    assert a == (tmp_path / "b.vdb").read_bytes()
    grids["density"] = grids["density"] * 2
    vdb.write_vdb(tmp_path / "c.vdb", grids, **PLACE)
    assert (tmp_path / "c.vdb").read_bytes()[21:57] != a[21:57]


@pytest.mark.parametrize(
    "bad", [np.full((2, 2, 2), np.nan), np.full((2, 2, 2), np.inf), np.zeros((2, 2)), np.zeros((2, 2, 2, 2))]
)
def test_a_grid_that_cannot_be_is_refused_and_nothing_is_written(tmp_path: Path, bad: np.ndarray) -> None:
    with pytest.raises(ValueError):
        vdb.write_vdb(tmp_path / "a.vdb", {"density": bad}, **PLACE)
    for place in ({"voxel_size": 0.0}, {"voxel_size": np.nan}, {"origin": (0.0, np.inf, 0.0)}):
        with pytest.raises(ValueError):
            vdb.write_vdb(tmp_path / "a.vdb", sample_grids(), **{**PLACE, **place})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("length", [0, 30, 57, 61, 90, 400, -1])
def test_what_a_full_disk_cut_off_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, length: int) -> None:
    module = vdb.openvdb_module()

    class Full:
        def write(self, path: str, grids: list) -> None:
            module.write(path, grids=grids)
            os.truncate(path, length if length >= 0 else os.path.getsize(path) + length)

        def __getattr__(self, name: str) -> object:
            return getattr(module, name)

    monkeypatch.setattr(vdb, "openvdb_module", Full)
    with pytest.raises(BackendError) as caught:
        vdb.write_vdb(tmp_path / "a.vdb", sample_grids(), **PLACE)
    assert caught.value.code == "disk_full"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("no_module")
@pytest.mark.parametrize("python", OTHER_PYTHONS, ids=lambda path: path.parent.parent.name)
def test_another_python_writes_the_same_voxels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, python: Path) -> None:
    if not python.is_file():
        pytest.skip(f"{python.parent.parent.name} is not set up")
    grids = sample_grids()
    monkeypatch.setenv(vdb.PYTHON_VARIABLE, str(python))
    assert vdb.check_writable() == str(python)
    vdb.write_vdb(tmp_path / "a.vdb", grids, **PLACE)
    assert [path.name for path in tmp_path.iterdir()] == ["a.vdb"]
    monkeypatch.undo()
    values, facts, world = read(tmp_path / "a.vdb", "density", grids["density"].shape)
    np.testing.assert_allclose(values, grids["density"], rtol=1e-3)
    assert world == pytest.approx((1.25, -1.5, 3.75))
    assert facts["half"]


@pytest.mark.usefixtures("no_module")
def test_without_any_openvdb_one_sentence_says_what_to_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BackendError, match=vdb.PYTHON_VARIABLE) as caught:
        vdb.write_vdb(tmp_path / "a.vdb", sample_grids(), **PLACE)
    assert caught.value.code == "openvdb_missing"
    monkeypatch.setenv(vdb.PYTHON_VARIABLE, str(tmp_path / "none"))
    with pytest.raises(BackendError, match="is no file"):
        vdb.check_writable()
    monkeypatch.setenv(vdb.PYTHON_VARIABLE, sys.executable)  # has no openvdb on its own path
    with pytest.raises(BackendError, match="no OpenVDB module"):
        vdb.write_vdb(tmp_path / "a.vdb", sample_grids(), **PLACE)
    failing = tmp_path / "python"
    failing.write_text("#!/bin/sh\necho broken beyond words >&2\nexit 9\n")
    failing.chmod(0o755)
    monkeypatch.setenv(vdb.PYTHON_VARIABLE, str(failing))
    with pytest.raises(BackendError, match="broken beyond words"):
        vdb.write_vdb(tmp_path / "a.vdb", sample_grids(), **PLACE)
    assert [path.name for path in tmp_path.iterdir()] == ["python"]


def test_a_module_for_another_python_is_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "openvdb.cpython-399-x86_64-linux-gnu.so").write_bytes(b"")
    monkeypatch.setenv(vdb.PATH_VARIABLE, str(tmp_path))
    module = vdb.openvdb_module()
    assert module is not None
    assert str(tmp_path) not in str(module.__file__)


def test_wheel_folders_are_those_of_this_python(tmp_path: Path) -> None:
    here = f"python{sys.version_info.major}.{sys.version_info.minor}"
    for release, version in (("4.5", here), ("5.0", here), ("9.9", "python3.99")):
        (tmp_path / "bpy" / release / "python" / "lib" / version / "site-packages").mkdir(parents=True)
    assert [folder.parts[-5] for folder in openvdb_file.wheel_folders(tmp_path)] == ["5.0", "4.5"]


def test_a_backend_process_ends_without_a_word(tmp_path: Path) -> None:
    script = (
        "import numpy as np\nfrom backend.io.vdb import write_vdb\n"
        f"write_vdb({str(tmp_path / 'a.vdb')!r}, {{'density': np.ones((4, 4, 4)), 'velocity': np.ones((4, 4, 4, 3))}},"
        " voxel_size=0.1, origin=(0, 0, 0))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=CHECKOUT, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    grids = sample_grids()
    vdb.write_vdb(tmp_path / "a.vdb", grids, **PLACE)
    for name, expected in grids.items():
        found = vdb.read_vdb(tmp_path / "a.vdb", name)
        assert found.voxel_size == pytest.approx(0.25)
        start = [round((a - b) / 0.25) for a, b in zip(found.origin, PLACE["origin"], strict=True)]
        assert start == [3, 5, 2]
        box = tuple(slice(a, a + size) for a, size in zip(start, found.values.shape[:3], strict=True))
        assert np.abs(found.values - expected[box]).max() < 2e-3  # half floats
        assert np.count_nonzero(found.values) == np.count_nonzero(expected)


def test_an_empty_grid_is_read_as_one_empty_voxel(tmp_path: Path) -> None:
    vdb.write_vdb(tmp_path / "a.vdb", {"density": np.zeros((4, 4, 4), np.float32)}, **PLACE)
    found = vdb.read_vdb(tmp_path / "a.vdb", "density")
    assert found.values.shape == (1, 1, 1) and found.values.max() == 0


def test_what_cannot_be_read_is_said(tmp_path: Path) -> None:
    vdb.write_vdb(tmp_path / "a.vdb", sample_grids(), **PLACE)
    (tmp_path / "broken.vdb").write_bytes((tmp_path / "a.vdb").read_bytes()[:300])
    for path, name in ((tmp_path / "none.vdb", "density"), (tmp_path / "a.vdb", "heat"), (tmp_path / "broken.vdb", "density")):
        with pytest.raises(BackendError) as caught:
            vdb.read_vdb(path, name)
        assert caught.value.code == "vdb_unreadable"


def test_turned_voxels_are_refused(tmp_path: Path) -> None:
    module = vdb.openvdb_module()
    assert module is not None
    grid = module.FloatGrid()
    grid.copyFromArray(np.ones((2, 2, 2), np.float32))
    grid.name = "density"
    grid.transform = module.createLinearTransform([[0.1, 0, 0, 0], [0, 0.2, 0, 0], [0, 0, 0.1, 0], [0, 0, 0, 1]])
    module.write(str(tmp_path / "a.vdb"), grids=[grid])
    del grid
    with pytest.raises(BackendError, match="no cubes"):
        vdb.read_vdb(tmp_path / "a.vdb", "density")
