"""The small set that ships: what it holds, that nothing is lost on the way, and that the one in the tree is whole."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import av
import cv2
import h5py
import numpy as np
import pytest

from backend.contract.cameras import read_cameras
from backend.contract.errors import BackendError
from backend.contract.truth import VOLUMES_FILE
from backend.io import vdb
from synthetic.layers import Layer
from synthetic.plan import plan_shipped
from synthetic.presets import PRESETS
from synthetic.record import main as record_main
from synthetic.shipped import SHIPPED_FOLDER, encode_smoke, in_8_bits, pack, pack_volumes

TINY = PRESETS["tiny"]


def decode(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="bgra") for frame in container.decode(video=0)])


def random_pictures(count: int = 4) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (count, 24, 18, 4), dtype=np.uint8)


def test_smoke_video_is_lossless_and_the_same_every_time(tmp_path: Path) -> None:
    pictures = random_pictures()
    for name in ("a.mkv", "b.mkv"):
        encode_smoke(iter(pictures), tmp_path / name, fps=15.0)
    assert np.array_equal(decode(tmp_path / "a.mkv"), pictures)
    assert (tmp_path / "a.mkv").read_bytes() == (tmp_path / "b.mkv").read_bytes()


def test_no_pictures_leave_no_video(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one"):
        encode_smoke(iter(()), tmp_path / "a.mkv", fps=15.0)
    assert not list(tmp_path.iterdir())


def test_8_bits_keep_the_coded_light_and_the_opacity() -> None:
    picture = np.random.default_rng(5).integers(400, 65536, (40, 30, 4)).astype(np.uint16)
    assert np.abs(in_8_bits(picture) / 255 - picture / 65535).max() <= 0.5 / 255 + 1e-6


def test_what_is_too_faint_to_show_is_nothing() -> None:
    assert not in_8_bits(np.full((2, 2, 4), 40, np.uint16)).any()  # 40 / 65535 rounds to 0


def test_only_what_ships_is_planned() -> None:
    bench = PRESETS["bench"]
    images = plan_shipped(bench)
    counts = {(image.view, image.layer): 0 for image in images}
    for image in images:
        counts[image.view, image.layer] += 1
    assert counts == {
        ("input", Layer.CLIP): 120,
        ("input", Layer.SMOKE): 135,
        ("nvs", Layer.SMOKE): 45,
        ("side", Layer.SMOKE): 15,
        ("back", Layer.SMOKE): 15,
    }


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny scene: real smoke, painted images."""
    if vdb.openvdb_module() is None:
        pytest.skip("no OpenVDB module for this Python")
    folder = tmp_path_factory.mktemp("scene")
    assert record_main(["simulate", "puff_front", "--out", str(folder), "--preset", "tiny"]) == 0
    for image in plan_shipped(TINY):
        path = folder / image.path
        path.parent.mkdir(parents=True, exist_ok=True)
        if image.layer is Layer.CLIP:
            cv2.imwrite(str(path), np.full((TINY.height, TINY.width, 3), 10 * image.frame, np.uint8))
        else:
            cv2.imwrite(str(path), np.full((TINY.height, TINY.width, 4), 3000 * (image.frame + 1), np.uint16))
    (folder / "render.json").write_text('{"blender": "none"}')
    return folder


def test_a_packed_scene_is_whole_and_leaks_nothing(scene: Path, tmp_path: Path) -> None:
    truth = json.loads(pack("puff_front", scene, TINY, tmp_path / "puff").read_text(), parse_constant=pytest.fail)
    readable = sorted(path.name for path in (tmp_path / "puff" / "input").iterdir())
    assert readable == ["cameras.json", "clip.mp4", "smoke.mkv"]
    assert len(decode(tmp_path / "puff" / "input" / "smoke.mkv")) == truth["frames"]["seen"] == 8
    assert len(decode(tmp_path / "puff" / "truth" / "future.mkv")) == 1
    assert truth["views"] == {"input": list(range(9)), "nvs": [0, 3, 6], "side": [0], "back": [0]}
    for view in ("nvs", "side", "back"):
        assert len(decode(tmp_path / "puff" / "truth" / view / "smoke.mkv")) == len(truth["views"][view])
        assert read_cameras(tmp_path / "puff" / "truth" / view / "cameras.json").is_still
    assert len(read_cameras(tmp_path / "puff" / "input" / "cameras.json").camera_to_world) == 9
    check_sums(tmp_path / "puff", truth)


def check_sums(folder: Path, truth: dict) -> None:
    """Every file is there as truth.json says, and no other."""
    found = {str(path.relative_to(folder).as_posix()) for path in folder.rglob("*") if path.is_file()} - {"truth/truth.json"}
    assert found == set(truth["sha256"])
    for name, expected in truth["sha256"].items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == expected, name


def test_packing_says_which_image_is_missing(scene: Path, tmp_path: Path) -> None:
    copy = tmp_path / "scene"
    shutil.copytree(scene, copy)
    (copy / "truth" / "nvs" / "smoke" / "0003.png").unlink()
    with pytest.raises(BackendError, match=r"1 images .* the first is truth/nvs/smoke/0003.png"):
        pack("puff_front", copy, TINY, tmp_path / "puff")
    assert not (tmp_path / "puff").exists()


def test_volumes_keep_the_mass_and_the_place(scene: Path, tmp_path: Path) -> None:
    facts = pack_volumes(scene / "smoke", tmp_path / VOLUMES_FILE, num_frames=9)
    with h5py.File(tmp_path / VOLUMES_FILE) as file:
        assert facts["density_frames"] == [0, 5] == list(file["density_frames"][:])
        coarse, size, origin = file["density"][1].astype(np.float64), float(file.attrs["voxel_size"]), file.attrs["origin"]
    fine = vdb.read_vdb(scene / "smoke" / "smoke_0006.vdb", "density")
    assert size == pytest.approx(2 * fine.voxel_size)
    mass = [(values.sum() * step**3) for values, step in ((coarse, size), (fine.values.astype(np.float64), fine.voxel_size))]
    assert mass[1] > 0.1
    assert mass[0] == pytest.approx(mass[1], rel=2e-3)
    for axis in range(3):
        middles = []
        for values, start, step in ((coarse, origin, size), (fine.values, fine.origin, fine.voxel_size)):
            weights = values.sum(axis=tuple(other for other in range(3) if other != axis))
            middles.append(start[axis] + step * (weights * np.arange(len(weights))).sum() / weights.sum())
        assert middles[0] == pytest.approx(middles[1], abs=0.05 * size)


@pytest.mark.parametrize("name", sorted(path.name for path in SHIPPED_FOLDER.glob("*")))
def test_the_set_in_the_tree_is_whole(name: str) -> None:
    folder = SHIPPED_FOLDER / name
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    check_sums(folder, truth)
    future = truth["frames"]["count"] - truth["frames"]["seen"]
    videos = {"input/smoke.mkv": truth["frames"]["seen"], "truth/future.mkv": future}
    videos |= {f"truth/{view}/smoke.mkv": len(frames) for view, frames in truth["views"].items() if view != "input"}
    for video, count in videos.items():
        with av.open(str(folder / video)) as container:
            assert sum(1 for _ in container.demux(video=0)) - 1 == count, video  # the last packet is the flush


def test_the_set_in_the_tree_is_small() -> None:
    sizes = [path.stat().st_size for path in SHIPPED_FOLDER.rglob("*") if path.is_file()]
    assert sum(sizes) <= 25e6
