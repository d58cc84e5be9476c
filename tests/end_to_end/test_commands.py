"""Every command, as a user calls it, on one small job."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_job import assert_whole, backend, backend_command, digest, environment, settings

from backend.contract import events
from backend.contract.decisions import read_decisions
from backend.contract.estimates import read_estimate, read_outlook
from backend.contract.job import PRESETS, read_job
from backend.contract.result import read_result
from backend.contract.running import process_start
from backend.io.particles import read_particles
from backend.pipeline import stages_of

CUBE = """
v -0.3 -0.3 0.4\nv 0.3 -0.3 0.4\nv 0.3 0.3 0.4\nv -0.3 0.3 0.4\nv -0.3 -0.3 1\nv 0.3 -0.3 1\nv 0.3 0.3 1\nv -0.3 0.3 1
f 1 4 3 2\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8
"""


@pytest.fixture(scope="module")
def job(plume: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("job")
    done = backend("reconstruct", plume, "--job", folder, *settings())
    assert done.returncode == 0, done.stdout + done.stderr
    seen = [events.decode(line) for line in done.stdout.splitlines()]
    assert isinstance(seen[0], events.Hello)
    assert isinstance(seen[-1], events.Done)
    assert sum(isinstance(event, events.LAST_EVENTS) for event in seen) == 1
    assert done.stderr == ""
    return folder


def test_the_job_is_whole_and_says_what_it_made(job: Path) -> None:
    result = read_result(job)
    assert (result.num_frames, result.num_forecast) == (10, 2)
    assert assert_whole(job) >= 12 + 6
    assert sorted(path.name for path in (job / "vdb").glob("*.vdb")) == [f"smoke_{n:04d}.vdb" for n in range(1, 13)]
    assert not (job / "running.json").exists()
    assert not list(job.rglob("*.part"))


def test_a_finished_job_is_not_done_again(job: Path, plume: Path) -> None:
    before = digest(job)
    done = backend("reconstruct", plume, "--job", job, *settings())
    assert done.returncode == 0
    stages = [event for event in map(events.decode, done.stdout.splitlines()) if isinstance(event, events.Stage)]
    config = read_job(job / "job.json").config()
    assert [stage.name for stage in stages] == list(stages_of(read_decisions(job).followed(config)))
    assert "volume" not in stages_of(read_decisions(job).followed(config)), "this camera stands still"
    assert all(stage.skipped for stage in stages)
    assert digest(job) == before


def test_render_reproduces_the_input_view(job: Path, plume: Path, tmp_path: Path) -> None:
    done = backend("render", "--job", job, "--cameras", job / "cameras.json", "--out", tmp_path / "frames")
    assert done.returncode == 0, done.stderr
    names = sorted(path.name for path in (tmp_path / "frames").iterdir())
    assert names == [f"{n:04d}.png" for n in range(12)]
    errors = []
    for number in range(10):
        shown = cv2.imread(str(tmp_path / "frames" / f"{number:04d}.png"), cv2.IMREAD_UNCHANGED)
        assert shown.shape[2] == 4
        given = cv2.imread(str(plume / f"{number:04d}.png"), cv2.IMREAD_GRAYSCALE)
        errors.append(np.mean((shown[..., 0] / 255.0 - given / 255.0) ** 2))
    assert -10 * np.log10(np.mean(errors)) > 28.0  # 23 dB is what black scores here, see below
    empty = np.mean([np.mean((cv2.imread(str(path), 0) / 255.0) ** 2) for path in sorted(plume.iterdir())])
    assert -10 * np.log10(empty) < 20.0


def test_the_forecast_can_be_made_longer(job: Path, tmp_path: Path) -> None:
    fitted = read_particles(job / "particles.h5").frame(9)
    done = backend("forecast", "--job", job, "--frames", "3")
    assert done.returncode == 0, done.stdout + done.stderr
    assert read_result(job).num_forecast == 3
    with read_particles(job / "particles.h5") as particles:
        np.testing.assert_array_equal(particles.frame(9).positions, fitted.positions)
        assert particles.frame(12).count > 0
    assert len(list((job / "vdb").glob("*.vdb"))) == 13


def test_simulate_flows_around_a_collider(job: Path, tmp_path: Path) -> None:
    mesh = tmp_path / "cube.obj"
    mesh.write_text(CUBE)
    done = backend("simulate", "--job", job, "--frames", "12", "--wind", "0.2,0,0", "--collider", mesh)
    assert done.returncode == 0, done.stdout + done.stderr
    with read_particles(job / "simulation" / "particles.h5") as particles:
        assert particles.num_frames == 12
        last = particles.frame(11)
        assert np.isfinite(last.positions).all()
        assert last.count > 0
    assert len(list((job / "simulation" / "vdb").glob("*.vdb"))) == 12
    refused = backend("simulate", "--job", job, "--frames", "2", "--collider", tmp_path / "nothing.obj")
    assert refused.returncode == 2
    assert json.loads(refused.stdout.splitlines()[-1])["code"] == "collider_missing"


def test_export_at_another_voxel_size(job: Path, tmp_path: Path) -> None:
    done = backend("export", "--job", job, "--vdb", tmp_path / "coarse", "--voxel-size", "0.4", "--frames", "2:5")
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in (tmp_path / "coarse").iterdir()) == [f"smoke_{n:04d}.vdb" for n in (3, 4, 5)]


def test_inspect_gives_its_reasons(plume: Path) -> None:
    done = backend("inspect", plume, "--json")
    assert done.returncode == 0, done.stderr
    decisions = json.loads(done.stdout)["decisions"]
    assert any(decision["value"] == "on_black" for decision in decisions)
    assert all(decision["reason"] for decision in decisions)
    assert "on_black" in backend("inspect", plume).stdout
    outlook = read_outlook(done.stdout)
    assert [item.preset for item in outlook.estimates] == list(PRESETS)
    assert all(item.seconds > 0.0 and item.memory_gib > 0.0 for item in outlook.estimates)


def test_a_job_keeps_what_was_decided_and_estimated_and_says_what_is_left(job: Path, plume: Path, tmp_path: Path) -> None:
    job = shutil.copytree(job, tmp_path / "job")
    decisions = read_decisions(job)
    assert decisions["extraction"].value == "on_black" and decisions["depth"].value == "silhouette"
    assert decisions["resolution"].is_overridden, "the small job sets frames.working_size"
    with read_particles(job / "particles.h5") as particles:
        assert particles.info.provenance["settings"]["extraction"]["mode"] == "on_black"
    expected = read_estimate((job / "estimate.json").read_text(encoding="utf-8"))
    assert expected.fingerprint == decisions.fingerprint and expected.quality == (), "its settings were never measured"
    shutil.rmtree(job / "vdb")
    (job / "result.json").unlink()
    heard = [events.decode(line) for line in backend("reconstruct", plume, "--job", job, *settings()).stdout.splitlines()]
    steps = [event for event in heard if isinstance(event, events.Progress)]
    assert steps and all(step.stage in ("forecast", "export") and step.job_seconds_left is not None for step in steps)
    assert all(step.seconds_left is not None for step in steps) and steps[-1].job_seconds_left == 0.0
    kinds = [event.kind for event in heard if isinstance(event, events.Artifact)]
    assert kinds[:2] == ["decisions", "estimate"]


def test_the_report_is_drawn(job: Path, tmp_path: Path) -> None:
    done = backend("report", "--job", job, "--out", tmp_path / "report.png")
    assert done.returncode == 0, done.stderr
    sheet = cv2.imread(str(tmp_path / "report.png"))
    assert sheet.shape[0] == 900
    assert sheet.std() > 10


def test_the_number_of_threads_changes_no_byte(plume: Path, job: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command = ("reconstruct", plume, *settings(**{"forecast.num_frames": "1"}))
    digests = []
    for threads in ("1", "2"):
        monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
        assert backend(*command, "--job", tmp_path / threads).returncode == 0
        digests.append(digest(tmp_path / threads))
    assert digests[0] == digests[1]


def test_two_backends_never_work_in_one_folder(job: Path, plume: Path) -> None:
    (job / "running.json").write_text(json.dumps({"pid": os.getpid(), "start": process_start(os.getpid())}))
    refused = backend("reconstruct", plume, "--job", job, *settings())
    assert refused.returncode == 2
    assert json.loads(refused.stdout.splitlines()[-1])["code"] == "job_running"
    (job / "running.json").write_text(json.dumps({"pid": 2**22 + 12345, "start": "1"}))  # left by one that was killed
    assert backend("reconstruct", plume, "--job", job, *settings()).returncode == 0
    assert not (job / "running.json").exists()


def test_end_of_input_stops_the_run(plume: Path, tmp_path: Path) -> None:
    """Blender died: standard input ends, the backend leaves soon and the job can go on."""

    folder = tmp_path / "job"
    slow = settings(**{"visual.iterations": "400", "visual.mass_iterations": "200"})
    first = subprocess.Popen(
        backend_command("reconstruct", plume, "--job", folder, *slow), stdout=subprocess.PIPE, text=True, env=environment()
    )
    assert first.stdout is not None
    for line in first.stdout:  # until the fit has begun
        if '"visual"' in line:
            break
    first.kill()
    first.wait()
    process = subprocess.Popen(
        backend_command("run", "--job", folder),
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment(),
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdin is not None
    for line in process.stdout:
        if '"visual"' in line:
            break
    process.stdin.close()
    began = time.monotonic()
    rest = process.stdout.read()
    process.wait()
    assert time.monotonic() - began < 2.0
    assert process.returncode == 0
    assert json.loads(rest.splitlines()[-1])["event"] == "cancelled"
    assert not (folder / "result.json").exists()
