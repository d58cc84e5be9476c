"""particles.h5: what goes in comes out, equal runs give equal bytes, and a damaged file is a sentence, not a crash."""

from __future__ import annotations

import dataclasses
import errno
import json
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from backend.contract.cameras import Cameras
from backend.contract.errors import BackendError
from backend.io.hdf5_sink import Hdf5Sink
from backend.io.particles import ParticleFrame, ParticlesInfo, ParticlesWriter, read_particles

EYE = ((1.0, 0.0, 0.0, 0.5), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
CAMERAS = Cameras(width=64, height=48, fx=50.0, fy=51.0, cx=31.5, cy=24.5, fps=29.97, camera_to_world=(EYE, EYE))
INFO = ParticlesInfo(
    cameras=CAMERAS,
    gravity=(0.0, 0.0, -9.81),
    frame_start=7,
    buoyancy=(0.1, 0.0, 1.5),
    buoyancy_uncertainty=(0.05, 0.05, 0.2),
    fluid={"smoothing_length_m": 0.1, "drag_per_second": 0.5},
    provenance={"version": "0.1.0", "settings": {"seed": 3}},
    fingerprint="abc",
)


def frame_of(ids: list[int], *, seed: int = 0, is_anisotropic: bool = False) -> ParticleFrame:
    random_numbers, n = np.random.default_rng(seed), len(ids)
    rotations = random_numbers.normal(size=(n, 4)).astype(np.float32) if is_anisotropic else None
    return ParticleFrame(
        positions=random_numbers.normal(size=(n, 3)) + 5e5,  # far from the origin, as in survey coordinates
        velocities=random_numbers.normal(size=(n, 3)).astype(np.float32),
        scales=random_numbers.random((n, 3) if is_anisotropic else n).astype(np.float32) + 0.1,
        optical_masses=random_numbers.random(n).astype(np.float32),
        colors=random_numbers.random((n, 3)).astype(np.float32),
        ids=np.array(ids, np.int64),
        rotations=rotations,
    )


FRAMES = [frame_of([1, 2, 3], seed=1), frame_of([], seed=2), frame_of([9, 4], seed=3), frame_of([9, 4, 12], seed=4)]


def write(path: Path, frames: list[ParticleFrame] = FRAMES, *, num_forecast: int = 1, info: ParticlesInfo = INFO) -> Path:
    with ParticlesWriter(path) as writer:
        for index, frame in enumerate(frames):
            writer.append(frame, is_forecast=index >= len(frames) - num_forecast)
        writer.finish(info)
    return path


@pytest.mark.parametrize("is_anisotropic", [False, True])
def test_every_array_of_every_frame_comes_back(tmp_path: Path, is_anisotropic: bool) -> None:
    frames = [frame_of(list(frame.ids), seed=seed, is_anisotropic=is_anisotropic) for seed, frame in enumerate(FRAMES)]
    with read_particles(write(tmp_path / "p.h5", frames)) as particles:
        assert (particles.num_frames, particles.num_forecast) == (3, 1)
        for index, expected in enumerate(frames):
            found = particles.frame(index)
            for item in dataclasses.fields(ParticleFrame):
                a, b = getattr(found, item.name), getattr(expected, item.name)
                if b is None:
                    assert a is None
                else:
                    assert a.dtype == b.dtype
                    np.testing.assert_array_equal(a, b)
        for outside in (-1, 4):
            with pytest.raises(IndexError):
                particles.frame(outside)


def test_what_holds_for_the_clip_comes_back(tmp_path: Path) -> None:
    with read_particles(write(tmp_path / "p.h5")) as particles:
        assert particles.info == INFO


def test_births_and_deaths(tmp_path: Path) -> None:
    with read_particles(write(tmp_path / "p.h5")) as particles:
        lives = dict(zip(particles.ids, zip(particles.birth_frames, particles.death_frames, strict=True), strict=True))
    assert lives == {1: (0, 1), 2: (0, 1), 3: (0, 1), 9: (2, 4), 4: (2, 4), 12: (3, 4)}


def test_readable_with_h5py_alone_as_the_documentation_says(tmp_path: Path) -> None:
    with h5py.File(write(tmp_path / "p.h5"), "r") as file:
        offsets = file["frames/offsets"][()]
        np.testing.assert_array_equal(file["particles/positions"][offsets[2] : offsets[3]], FRAMES[2].positions)
        assert file["particles/optical_masses"].attrs["unit"] == b"m^2"
        assert file["particles/scales"].attrs["unit"] == b"m"
        assert json.loads(file["cameras/json"][()].decode())["fps"] == 29.97
        assert file["cameras/camera_to_world"].shape == (2, 4, 4)
        assert json.loads(file["provenance"][()].decode())["version"] == "0.1.0"
        assert file["physics"].attrs["buoyancy"][2] == 1.5
        assert file["physics/fluid"].attrs["smoothing_length_m"] == 0.1
        assert int(file.attrs["frame_start"]) == 7


def test_equal_input_gives_equal_bytes_at_another_time(tmp_path: Path) -> None:
    first = write(tmp_path / "a.h5").read_bytes()
    time.sleep(1.1)  # HDF5 stores times in seconds, if it stores them
    assert write(tmp_path / "b.h5").read_bytes() == first


def test_an_asset_without_frames_or_particles(tmp_path: Path) -> None:
    with read_particles(write(tmp_path / "none.h5", [], num_forecast=0)) as particles:
        assert particles.num_frames == particles.num_forecast == 0
    with read_particles(write(tmp_path / "empty.h5", [frame_of([])] * 2, num_forecast=0)) as particles:
        assert particles.frame(1).count == 0
        assert len(particles.ids) == 0


def test_many_rows_cross_the_borders_of_chunks(tmp_path: Path) -> None:
    frames = [frame_of(list(range(5000)), seed=seed) for seed in range(4)]
    with read_particles(write(tmp_path / "p.h5", frames)) as particles:
        for index, frame in enumerate(frames):
            np.testing.assert_array_equal(particles.frame(index).positions, frame.positions)


def test_a_chunk_is_packed_once_however_many_frames_it_holds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = []
    put = Hdf5Sink.write

    def counted(sink: Hdf5Sink, data: memoryview) -> int:
        written.append(len(data))
        return put(sink, data)

    monkeypatch.setattr(Hdf5Sink, "write", counted)
    frames = [frame_of(list(range(100 * step, 100 * step + 100)), seed=step) for step in range(40)]
    path = write(tmp_path / "particles.h5", frames)
    assert sum(written) < 1.2 * path.stat().st_size


def test_nothing_appears_unless_it_was_finished(tmp_path: Path) -> None:
    path = tmp_path / "p.h5"
    with pytest.raises(ValueError, match="finish"), ParticlesWriter(path) as writer:
        writer.append(FRAMES[0])
    with pytest.raises(KeyboardInterrupt):
        interrupted(path)
    assert list(tmp_path.iterdir()) == []


def interrupted(path: Path) -> None:
    with ParticlesWriter(path) as writer:
        writer.append(FRAMES[0])
        writer.finish(INFO)
        raise KeyboardInterrupt


def test_a_failure_leaves_the_old_file_alone(tmp_path: Path) -> None:
    path = write(tmp_path / "p.h5")
    before = path.read_bytes()
    with pytest.raises(ValueError), ParticlesWriter(path) as writer:
        writer.append(dataclasses.replace(FRAMES[0], scales=-FRAMES[0].scales))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("room", [0, 3000, 40_000])
def test_a_full_disk_is_a_sentence_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int) -> None:
    class Full:
        def __init__(self, path: Path) -> None:
            self.file, self.left = open(path, "w+b", buffering=0), room  # noqa: SIM115

        def write(self, data: memoryview) -> int:
            if self.left < len(data):
                raise OSError(errno.ENOSPC, "No space left on device")
            self.left -= len(data)
            return self.file.write(data)

        def __getattr__(self, name: str):
            return getattr(self.file, name)

    monkeypatch.setattr("backend.io.hdf5_sink.open", lambda path, *_, **__: Full(path), raising=False)
    frames = [frame_of(list(range(3000)), seed=seed) for seed in range(6)]
    with pytest.raises(BackendError) as caught:
        write(tmp_path / "p.h5", frames)
    assert caught.value.code == "disk_full"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "change",
    [
        {"positions": np.full((3, 3), np.nan)},
        {"positions": np.zeros((3, 2))},
        {"velocities": np.full((3, 3), np.inf)},
        {"velocities": np.full((3, 3), 1e300)},  # more than float32 holds
        {"scales": np.zeros(3)},
        {"scales": np.full(3, 1e-60)},  # 0 in float32
        {"optical_masses": np.array([1.0, -1.0, 1.0])},
        {"optical_masses": np.ones(2)},
        {"ids": np.array([1, 1, 2])},
        {"ids": np.array([1.0, 2.0, 3.0])},
        {"rotations": np.ones((3, 4))},
    ],
)
def test_a_frame_that_is_not_as_described_is_refused(tmp_path: Path, change: dict[str, np.ndarray]) -> None:
    with pytest.raises(ValueError), ParticlesWriter(tmp_path / "p.h5") as writer:
        writer.append(dataclasses.replace(FRAMES[0], **change))


def test_ids_do_not_return_and_fitted_frames_come_first(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="comes back"):
        write(tmp_path / "p.h5", [frame_of([1]), frame_of([2]), frame_of([1])])
    with ParticlesWriter(tmp_path / "p.h5") as writer:
        writer.append(FRAMES[0], is_forecast=True)
        with pytest.raises(ValueError, match="forecast"):
            writer.append(FRAMES[0])
        writer.finish(INFO)


def test_missing_foreign_and_newer_files_have_their_own_sentences(tmp_path: Path) -> None:
    with pytest.raises(BackendError, match="There is no"):
        read_particles(tmp_path / "none.h5")
    text = tmp_path / "text.h5"
    text.write_text("smoke")
    with pytest.raises(BackendError, match="no HDF5"):
        read_particles(text)
    with h5py.File(tmp_path / "foreign.h5", "w"):
        pass
    with pytest.raises(BackendError, match="not written by this program"):
        read_particles(tmp_path / "foreign.h5")
    newer = write(tmp_path / "newer.h5")
    with h5py.File(newer, "r+") as file:
        file.attrs["format_version"] = 99
    with pytest.raises(BackendError, match="format version 99") as caught:
        read_particles(newer)
    assert caught.value.code == "particles_version"


def read_all(path: Path) -> None:
    with read_particles(path) as particles:
        for index in range(particles.num_frames + particles.num_forecast):
            particles.frame(index)


@pytest.mark.parametrize("name", ["particles/positions", "frames/offsets", "identities/ids"])
def test_a_count_beyond_the_file_is_refused_before_memory_is_asked_for(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / "p.h5")
    with h5py.File(path, "r+") as file:
        shape, dtype = file[name].shape, file[name].dtype
        del file[name]
        huge = (10**12, *shape[1:])
        file.create_dataset(name, shape=huge, maxshape=(None, *shape[1:]), chunks=(1024, *shape[1:]), dtype=dtype)
    with pytest.raises(BackendError, match=r"claims|shape|number of frames"):
        read_all(path)


def test_offsets_that_claim_more_than_there_is(tmp_path: Path) -> None:
    for values in ([0, 3, 3, 5, 10**15], [0, 3, 2, 5, 8], [1, 3, 3, 5, 8]):
        path = write(tmp_path / "p.h5")
        with h5py.File(path, "r+") as file:
            file["frames/offsets"][...] = values
        with pytest.raises(BackendError):
            read_all(path)
