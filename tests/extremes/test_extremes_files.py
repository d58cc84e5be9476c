"""Files and streams that were cut off, hit by a flipped bit, or claim huge counts: a sentence, never a crash."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import h5py
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from backend.contract import events
from backend.contract.cameras import parse_cameras, read_cameras
from backend.contract.errors import BackendError
from backend.contract.job import Job, checked_job, read_job
from backend.contract.result import read_result
from backend.fit.state import PhysicalRecord
from backend.io.particles import ParticleFrame, ParticlesInfo, ParticlesWriter, read_particles
from backend.io.records import RecordFile
from tests.extremes.draws import same_draws
from tests.extremes.small_fit import around
from tests.reference.refusals import told

PART = "Files and streams"
EVENTS = (
    events.Hello(protocol=1, version="0.1.0", device="cpu"),
    events.Stage(name="frames", index=0, count=8),
    events.Progress(stage="frames", step=3, total=120, seconds_left=4.5, metrics={"loss": 0.25}),
    events.Artifact(kind="vdb", path="vdb/smoke_0001.vdb", frame=0),
    events.Warning(code="camera_moves", message="The camera moves \u2013 \u00e4 bit."),
    events.Error(code="no_smoke", message="No smoke was found.", hint="Give another clip."),
    events.Done(result="result.json", seconds=12.5),
)


def damaged(data: bytes, chance: random.Random) -> bytes:
    """Cut off, a bit flipped, a run of bytes overwritten, left out or doubled."""
    changed = bytearray(data)
    at = chance.randrange(len(data))
    length = chance.randint(1, 12)
    match chance.randrange(5):
        case 0:
            return bytes(changed[:at])
        case 1:
            changed[at] ^= 1 << chance.randrange(8)
        case 2:
            changed[at : at + length] = chance.randbytes(length)
        case 3:
            del changed[at : at + length]
        case _:
            changed[at:at] = changed[at : at + length]
    return bytes(changed)


def number_of_tries(table, short: int) -> int:
    return short * (10 if table.is_full else 1)


# -- the event stream --------------------------------------------------------------------------------------------------


def test_a_damaged_stream(table):
    """A line is an event or a ProtocolError; what is an event can be written again."""
    chance = random.Random(1)
    stream = "\n".join(events.encode(event) for event in EVENTS).encode() + b"\n"
    crashed, lines = 0, 0
    for _ in range(number_of_tries(table, 400)):
        for line in damaged(stream, chance).split(b"\n"):
            lines += 1
            try:
                event = events.decode(line)
                assert events.decode(events.encode(event)) == event
            except events.ProtocolError:
                continue
            except (ArithmeticError, LookupError, MemoryError, RecursionError, TypeError, UnicodeError):
                crashed += 1
    table.row(
        "the event stream", tried=f"{lines:,} lines, some cut off, flipped, overwritten, doubled",
        happens="an event, or not one", measure="crashes", worst=crashed, bound=0,
    )  # fmt: skip


def test_huge_counts_in_the_stream(table):
    """Whole numbers are at most what 64 bits hold: shares of them can be taken."""
    crashed = 0
    for digits in (1, 18, 19, 20, 300, 400, 4000, 5000, 100_000):
        for name in ("step", "total"):
            values = {"event": "progress", "stage": "visual", "step": 1, "total": 2}
            line = json.dumps(values).replace(f'"{name}": {values[name]}', f'"{name}": 1' + digits * "0")
            try:
                event = events.decode(line)
            except events.ProtocolError:
                continue
            assert isinstance(event, events.Progress)
            crashed += not math.isfinite(event.step / max(event.total, 1))
    table.row(
        "counts in the stream", tried="up to 100 000 digits", happens="no event beyond 64 bits", measure="crashes",
        worst=crashed, bound=0,
    )  # fmt: skip


# -- JSON files --------------------------------------------------------------------------------------------------------


def fuzzed_text(
    table, path: Path, read: Callable[[Path], object], check: Callable[[object], None], *, seed: int
) -> tuple[int, int]:
    """How many damaged versions were tried, and how many ended neither well nor with two sentences."""
    data, chance = path.read_bytes(), random.Random(seed)
    versions = [data[:length] for length in range(0, len(data), max(1, len(data) // 60))]
    versions += [damaged(data, chance) for _ in range(number_of_tries(table, 300))]
    crashed = 0
    for version in versions:
        path.write_bytes(version)
        try:
            if told(lambda: read(path)) is None:
                check(read(path))
        except (ArithmeticError, LookupError, MemoryError, OSError, RecursionError, TypeError, ValueError):
            crashed += 1
    return len(versions), crashed


def test_damaged_jobs(table, tmp_path: Path):
    """What is read is a job whose settings all lie within their ranges."""
    job = Job(video="clip.mp4", frame_start=2, frame_stop=40, overrides={"visual.iterations": 7, "physical.drag": "0.25"})
    path = tmp_path / "job.json"
    path.write_text(job.to_json(), encoding="utf-8")

    def check(found: object) -> None:
        assert isinstance(found, Job)
        checked_job(found)

    tried, crashed = fuzzed_text(table, path, read_job, check, seed=2)
    table.row(
        "job.json", tried=f"{tried} damaged files", happens="a job within its ranges, or refused", measure="crashes",
        worst=crashed, bound=0,
    )  # fmt: skip


def test_damaged_cameras(table, tmp_path: Path):
    path = tmp_path / "cameras.json"
    path.write_text(around(3).to_json(), encoding="utf-8")

    def check(found: object) -> None:
        for matrix in found.camera_to_world:  # type: ignore[attr-defined]
            rotation = np.array(matrix)[:3, :3]
            assert np.abs(rotation.T @ rotation - np.eye(3)).max() < 2e-3
            assert np.isfinite(matrix).all()

    tried, crashed = fuzzed_text(table, path, read_cameras, check, seed=3)
    table.row(
        "cameras.json", tried=f"{tried} damaged files", happens="cameras that are cameras, or refused", measure="crashes",
        worst=crashed, bound=0,
    )  # fmt: skip


def test_huge_numbers_in_cameras(table):
    """A picture of a billion pixels a side would ask for the memory."""
    data = json.loads(around(1).to_json())
    far = [list(row) for row in data["camera_to_world"][0]]
    far[0][3] = 1e300
    let_through = []
    for changes in ({"width": 10**9, "height": 10**9}, {"width": 1e400}, {"fx": 1e13}, {"camera_to_world": far}):
        text = json.dumps({**data, **changes})
        if told(lambda text=text: parse_cameras(text)) is None:
            let_through.append(changes)
    table.row(
        "numbers in cameras.json", tried="sizes of 1e9 px, infinity, focal 1e13, 1e300 m away", happens="refused",
        measure="cases let through", worst=len(let_through), bound=0,
    )  # fmt: skip


def test_damaged_results(table, tmp_path: Path):
    path = tmp_path / "result.json"
    values = {
        "format_version": 1, "particles": "particles.h5", "cameras": "cameras.json", "vdb_folder": "vdb", "num_frames": 3,
        "num_forecast": 1, "frame_start": 0, "fps": 24.0, "voxel_size": 0.1, "has_color": False, "smoke_color": [1.0, 1.0, 1.0],
        "bounds": [[0, 0, 0], [1, 1, 1]], "buoyancy": [0, 0, 1.0],
    }  # fmt: skip
    path.write_text(json.dumps(values), encoding="utf-8")
    read_result(tmp_path)
    tried, crashed = fuzzed_text(table, path, lambda found: read_result(found.parent), lambda _: None, seed=4)
    table.row(
        "result.json", tried=f"{tried} damaged files", happens="a result, or refused", measure="crashes", worst=crashed,
        bound=0,
    )  # fmt: skip


# -- particles.h5 ------------------------------------------------------------------------------------------------------


def frame_of(ids: list[int], seed: int) -> ParticleFrame:
    chance, count = np.random.default_rng(seed), len(ids)
    return ParticleFrame(
        positions=chance.normal(size=(count, 3)), velocities=chance.normal(size=(count, 3)).astype(np.float32),
        scales=(chance.random(count) + 0.1).astype(np.float32), optical_masses=chance.random(count).astype(np.float32),
        colors=chance.random((count, 3)).astype(np.float32), ids=np.array(ids, np.int64),
    )  # fmt: skip


FRAMES = [frame_of([1, 2, 3], 1), frame_of([], 2), frame_of([9, 4], 3)]
INFO = ParticlesInfo(
    cameras=around(3), gravity=(0.0, 0.0, -9.81), frame_start=7, buoyancy=(0.1, 0.0, 1.5), fluid={"smoothing_length_m": 0.1},
    provenance={"program": "wildsmoke", "settings": {"seed": 3}}, fingerprint="abc",
)  # fmt: skip


def asset(path: Path) -> Path:
    with ParticlesWriter(path) as writer:
        for index, frame in enumerate(FRAMES):
            writer.append(frame, is_forecast=index == 2)
        writer.finish(INFO)
    return path


def all_of(path: Path) -> tuple[object, ...]:
    """Everything that the file says: equal where two say the same."""
    with read_particles(path) as particles:
        frames = [particles.frame(index) for index in range(particles.num_frames + particles.num_forecast)]
        columns = [getattr(frame, item.name) for frame in frames for item in fields(frame)]
        arrays = [*columns, particles.ids, particles.birth_frames, particles.death_frames]
        counts = (particles.num_frames, particles.num_forecast)
        return particles.info, counts, tuple(None if array is None else (array.shape, array.tobytes()) for array in arrays)


def test_damaged_particles(table, tmp_path: Path):
    """Cut off at any length it is refused; with a bit flipped anywhere it is refused, or says what it said."""
    path = asset(tmp_path / "particles.h5")
    expected, data, chance = all_of(path), path.read_bytes(), random.Random(5)
    damaged_path = tmp_path / "damaged.h5"
    cut = [0, 1, 8, 48, 100, *np.linspace(200, len(data) - 1, number_of_tries(table, 25)).astype(int).tolist()]
    let_through = wrong = refused = 0
    for length in cut:
        damaged_path.write_bytes(data[:length])
        let_through += told(lambda: all_of(damaged_path)) is None
    table.row(
        "particles.h5, cut off", tried=f"{len(cut)} lengths", happens="refused", measure="cases let through", worst=let_through,
        bound=0,
    )  # fmt: skip
    flips = number_of_tries(table, 300)
    for _ in range(flips):
        changed = bytearray(data)
        changed[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        damaged_path.write_bytes(changed)
        try:
            wrong += all_of(damaged_path) != expected
        except BackendError:
            refused += 1
    assert refused > flips // 10
    table.row(
        "particles.h5, a bit flipped", tried=f"{flips} of {8 * len(data):,} bits", happens="refused, or reads as it was",
        measure="wrong without a word", worst=wrong, bound=0,
    )  # fmt: skip


def test_changed_headers_of_particles(table, tmp_path: Path):
    """Changed through HDF5 itself, whose checksums then agree: only the digest can tell."""
    let_through = []
    changes: dict[str, Callable[[h5py.File], None]] = {
        "fps": lambda file: file.attrs.__setitem__("fps", 25.0),
        "frame_start": lambda file: file.attrs.__setitem__("frame_start", 8),
        "gravity": lambda file: file["physics"].attrs.__setitem__("gravity", np.array([0.0, 0.0, 9.81])),
        "births": lambda file: file["identities/birth_frames"].__setitem__(0, 1),
        "cameras": lambda file: file["cameras/intrinsics"].__setitem__(0, 1.0),
        "fluid": lambda file: file["physics/fluid"].attrs.__setitem__("smoothing_length_m", 0.2),
    }
    for name, change in changes.items():
        path = asset(tmp_path / f"{name}.h5")
        with h5py.File(path, "r+") as file:
            change(file)
        if told(lambda path=path: all_of(path)) is None:
            let_through.append(name)
    table.row(
        "particles.h5, header changed", tried=", ".join(changes), happens="refused by its digest", measure="cases let through",
        worst=len(let_through), bound=0,
    )  # fmt: skip
    old = asset(tmp_path / "old.h5")
    with h5py.File(old, "r+") as file:
        del file.attrs["header_digest"]
    assert all_of(old)[0] == INFO  # as an older program wrote it


@same_draws
@given(count=st.integers(-(2**63), 2**63 - 1), place=st.integers(0, 3))
def test_any_count_in_the_offsets(tmp_path_factory, count: int, place: int):
    path = asset(tmp_path_factory.mktemp("counts") / "particles.h5")
    with h5py.File(path, "r+") as file:
        before = int(file["frames/offsets"][place])
        file["frames/offsets"][place] = count
    assert (told(lambda: all_of(path)) is None) == (count == before)


def test_stage_files_that_are_missing_or_damaged(table, tmp_path: Path):
    let_through = 0
    for number, data in enumerate((None, b"", b"not HDF5", b"\x89HDF\r\n\x1a\n" + bytes(100))):
        path = tmp_path / f"{number}.h5"
        if data is not None:
            path.write_bytes(data)
        let_through += told(lambda path=path: RecordFile(path, PhysicalRecord)) is None
    table.row(
        "files of a stage", tried="missing, empty, text, a torn header", happens="refused: not finished",
        measure="cases let through", worst=let_through, bound=0,
    )  # fmt: skip
