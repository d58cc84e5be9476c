"""A job that asks the trained prior: its stage among the others, its file, resume, stale weights, and jobs without it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from small_job import SMALL, assert_whole, digest, draw_plume
from wildsmoke.addon.status import STAGE_LABELS

from backend.contract import events
from backend.contract.cameras import read_cameras
from backend.contract.decisions import read_decisions
from backend.contract.errors import BackendError, Cancelled
from backend.contract.job import Config, Job, override
from backend.events_out import StopRequest
from backend.geometry.camera import view_at
from backend.io.job_folder import JobFolder, fingerprint
from backend.io.particles import read_particles
from backend.io.records import read_stamp
from backend.pipeline import STAGES, run_job, stages_of
from backend.prior.network import PlumeNet
from backend.prior.predict import save_weights
from backend.prior.weights import weights_fingerprint
from synthetic.sweep import Orbit, orbit_cameras

NUM_FRAMES = 7
WITHOUT = tuple(name for name in STAGES if name != "volume")


class Heard:
    """A sink that remembers."""

    def __init__(self) -> None:
        self.events: list[events.Event] = []

    def send(self, event: events.Event) -> None:
        self.events.append(event)

    def close(self) -> None: ...

    def stages(self, *, skipped: bool) -> list[str]:
        return [event.name for event in self.events if isinstance(event, events.Stage) and event.skipped is skipped]


class StopsWhen(StopRequest):
    """A user who cancels as soon as something is so."""

    def __init__(self, is_so: Callable[[], bool]) -> None:
        super().__init__()
        self._is_so = is_so

    def check(self) -> None:
        if self._is_so():
            raise Cancelled


def written(path: Path, *, seed: int) -> Path:
    """Random weights of a narrow net."""
    torch.manual_seed(seed)
    net = PlumeNet((8, 8, 8))
    for part in (net.first, net.second):
        torch.nn.init.normal_(part.exit.weight, std=0.1)
    with open(path, "wb") as file:
        save_weights(net, file)
    return path


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera goes around the smoke."""
    folder = tmp_path_factory.mktemp("clip")
    orbit = Orbit(azimuth_start=0.0, azimuth_stop=20.0)
    cameras = orbit_cameras(orbit, width=48, height=64, fps=15.0, num_frames=NUM_FRAMES)
    (folder / "cameras.json").write_text(cameras.to_json(), encoding="utf-8")
    return draw_plume(folder / "plume", num_frames=NUM_FRAMES)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("prior") / "weights.npz", seed=1)


def run(clip: Path, folder: Path, weights: Path, *, stop: StopRequest | None = None, **changes: object) -> Heard:
    heard = Heard()
    asked = {"volume.use_prior": True, **{key.replace("__", "."): value for key, value in changes.items()}}
    asked = {key: value for key, value in asked.items() if value is not None}
    folder.mkdir(exist_ok=True)
    JobFolder(folder).write_job(Job(video=str(clip), cameras=str(clip.parent / "cameras.json"), overrides={**SMALL, **asked}))
    run_job(folder, heard, stop or StopRequest(), weights=weights)
    return heard


@pytest.fixture(scope="module")
def job(clip: Path, weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("job")
    heard = run(clip, folder, weights)
    told = [event for event in heard.events if isinstance(event, events.Stage)]
    assert [(stage.name, stage.index, stage.count) for stage in told] == [(name, n, 9) for n, name in enumerate(STAGES)]
    ends = [event for event in heard.events if isinstance(event, events.Progress) and event.stage == "volume"]
    assert ends[-1].step == ends[-1].total > NUM_FRAMES
    assert [end.step for end in ends] == sorted(end.step for end in ends)
    return folder


@pytest.fixture(scope="module")
def plain(clip: Path, weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plain")
    assert run(clip, folder, weights, volume__use_prior=False).stages(skipped=False) == list(WITHOUT)
    return folder


def test_volumes_are_kept_in_half_precision_and_told_to_the_fit(job: Path, plain: Path, weights: Path) -> None:
    assert assert_whole(job) > 10
    assert not (job / "stages" / "volume.parts").exists()
    with h5py.File(job / "stages" / "volume.h5") as file:
        assert len(file) == file.attrs["num_frames"] == NUM_FRAMES
        frame = file["000003"]
        assert frame["density"].dtype == frame["velocity"].dtype == np.float16
        assert np.abs(frame["density"][()]).max() == np.abs(frame["velocity"][()]).max() == 1.0
    assert (job / "stages" / "volume.h5").stat().st_size < 1.1 * NUM_FRAMES * 36 * 36 * 60 * 4 * 2
    with read_particles(job / "particles.h5") as asked, read_particles(plain / "particles.h5") as unasked:
        assert asked.info.provenance["prior_fingerprint"] == weights_fingerprint(weights)
        assert "prior_fingerprint" not in unasked.info.provenance
        assert asked.frame(4).velocities.tobytes() != unasked.frame(4).velocities.tobytes()
    for name in ("physical", "visual"):
        with h5py.File(job / "stages" / f"{name}.h5") as told, h5py.File(plain / "stages" / f"{name}.h5") as untold:
            assert told["000004/positions"][()].tobytes() != untold["000004/positions"][()].tobytes(), name
    assert "volume" in json.loads((job / "timing.json").read_text())


def test_it_is_done_once(job: Path, clip: Path, weights: Path) -> None:
    before = digest(job)
    assert run(clip, job, weights).stages(skipped=True) == list(STAGES)
    assert digest(job) == before


def test_an_interrupted_stage_goes_on_and_ends_with_the_same_bytes(job: Path, clip: Path, weights: Path, tmp_path: Path) -> None:
    parts = tmp_path / "job" / "stages" / "volume.parts"
    with pytest.raises(Cancelled):
        run(clip, tmp_path / "job", weights, stop=StopsWhen(lambda: len(list(parts.glob("*.npz"))) >= 2))
    kept = {path: path.stat().st_mtime_ns for path in sorted(parts.glob("*.npz"))}
    assert 2 <= len(kept) < NUM_FRAMES
    assert not parts.with_suffix(".h5").exists()
    watched: dict[Path, int] = {}

    def look() -> bool:
        watched.update({path: path.stat().st_mtime_ns for path in kept if path.exists()})
        return False

    heard = run(clip, tmp_path / "job", weights, stop=StopsWhen(look))
    assert watched == kept, "frames that were there are not computed again"
    first = next(event for event in heard.events if isinstance(event, events.Progress) and event.stage == "volume")
    assert 0 < len(kept) < first.step < first.total
    assert digest(tmp_path / "job") == digest(job)


def test_other_weights_make_what_follows_from_them_stale(job: Path, clip: Path, tmp_path: Path) -> None:
    other = written(tmp_path / "weights.npz", seed=2)
    folder = tmp_path / "job"
    run(clip, folder, other)
    marks = {name: read_stamp(folder / "stages" / f"{name}.h5") for name in ("volume", "physical", "visual")}
    again = written(tmp_path / "weights.npz", seed=3)
    heard = run(clip, folder, again)
    assert heard.stages(skipped=True) == ["inspect", "frames", "smoke", "cameras"]
    assert heard.stages(skipped=False) == list(STAGES[4:])
    for name, mark in marks.items():
        assert read_stamp(folder / "stages" / f"{name}.h5") not in (None, mark, read_stamp(job / "stages" / f"{name}.h5"))


def test_smoke_before_a_camera_that_stands_still_is_as_deep_as_wide(clip: Path, weights: Path, tmp_path: Path) -> None:
    cameras = read_cameras(clip.parent / "cameras.json")
    still = replace(cameras, camera_to_world=(cameras.camera_to_world[0],) * NUM_FRAMES)
    (clip.parent / "still").mkdir()
    (clip.parent / "still" / "cameras.json").write_text(still.to_json(), encoding="utf-8")
    (clip.parent / "still" / "plume").symlink_to(clip)
    heard = run(clip.parent / "still" / "plume", tmp_path / "job", weights)
    assert heard.stages(skipped=False) == list(STAGES)
    decision = read_decisions(tmp_path / "job")["depth"]
    assert decision.value == "silhouette" and decision.sets == {"volume.as_deep_as_wide": True}
    drawn_out = run(clip.parent / "still" / "plume", tmp_path / "other", weights, volume__as_deep_as_wide=False)
    assert drawn_out.stages(skipped=False) == list(STAGES)
    assert deep(tmp_path / "job") < 0.8 * deep(tmp_path / "other")


def deep(job: Path) -> float:
    """Standard deviation of the last fitted frame's smoke along the view, m."""
    with read_particles(job / "particles.h5") as particles:
        frame, view = particles.frame(NUM_FRAMES - 1), view_at(particles.info.cameras, 0)
        along, masses = view.to_camera(frame.positions)[:, 2], frame.optical_masses.astype(np.float64)
        return float(np.sqrt(np.average(np.square(along - np.average(along, weights=masses)), weights=masses)))


def test_without_the_prior_nothing_changes(plain: Path, clip: Path, tmp_path: Path) -> None:
    """The fingerprints are those of versions that had no prior, and neither its settings nor its weights have a say."""
    config = read_decisions(plain).followed(override(Config(), SMALL))
    assert not (plain / "stages" / "volume.h5").exists()
    smoke, cameras = read_stamp(plain / "stages/smoke.h5"), json.loads((plain / "cameras.json").read_text())["fingerprint"]
    physical = fingerprint("physical", config.physical, "0", smoke, cameras)
    assert read_stamp(plain / "stages/physical.h5") == physical
    assert read_stamp(plain / "stages/visual.h5") == fingerprint("visual", config.visual, "0", smoke, cameras, physical)
    heard = run(clip, plain, tmp_path / "nowhere.npz", volume__use_prior=False, volume__stride=5)
    assert heard.stages(skipped=True) == list(WITHOUT[1:-1]), "another stride is looked at again, and ends the old result.json"
    assert {stage.count for stage in heard.events if isinstance(stage, events.Stage)} == {8}


@pytest.mark.parametrize("method", ["as_published", "fluidnexus"])
def test_the_published_methods_never_ask(method: str) -> None:
    assert stages_of(override(Config(), {"method": method, "volume.use_prior": True})) == WITHOUT
    assert stages_of(override(Config(), {"volume.use_prior": True})) == STAGES


def test_missing_weights_are_told_before_any_work(clip: Path, tmp_path: Path) -> None:
    with pytest.raises(BackendError) as caught:
        run(clip, tmp_path / "job", tmp_path / "nowhere.npz")
    assert caught.value.code == "prior_missing"
    assert "nowhere.npz" in caught.value.message
    assert caught.value.message.endswith(".")
    assert "volume.use_prior=false" in caught.value.hint
    assert not (tmp_path / "job" / "running.json").exists()
    assert not (tmp_path / "job" / "stages" / "frames.h5").exists()


def test_a_file_that_holds_no_weights_is_told(clip: Path, weights: Path, tmp_path: Path) -> None:
    whole = weights.read_bytes()
    net = PlumeNet((8, 8, 8))
    with np.load(weights) as arrays:
        some = {name: arrays[name] for name in arrays.files if not name.startswith("second.exit")}
    np.savez(tmp_path / "some.npz", **some)
    texts = {"half.npz": whole[: len(whole) // 2], "text.npz": b"version https://example.org/pointer\n", "empty.npz": b""}
    for name, content in texts.items():
        (tmp_path / name).write_bytes(content)
    for name in ("some.npz", *texts):
        with pytest.raises(BackendError) as caught:
            run(clip, tmp_path / "job", tmp_path / name)
        assert (caught.value.code, caught.value.stage) == ("prior_unreadable", "volume"), name
    assert "second.exit.bias" in net.state_dict(), "what was left out is part of a net"


def test_the_panel_has_words_for_every_stage() -> None:
    assert set(STAGE_LABELS) == set(STAGES)
