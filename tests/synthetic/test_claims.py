"""No two workers make one file; a dead worker's claim is taken over."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from synthetic.claims import claimed, write_once

CHECKOUT = Path(__file__).resolve().parents[2]


def claim_of(target: Path) -> Path:
    return target.with_name(target.name + ".claim")


def test_one_at_a_time(tmp_path: Path) -> None:
    target = tmp_path / "0001.png"
    with claimed(target) as first:
        assert first
        with claimed(target) as second:
            assert not second
        assert claim_of(target).exists()
    assert list(tmp_path.iterdir()) == []
    with claimed(target) as again:
        assert again


def test_a_finished_file_is_not_made_again(tmp_path: Path) -> None:
    target = tmp_path / "0001.png"
    target.write_bytes(b"x")
    with claimed(target) as is_ours:
        assert not is_ours


def test_a_failure_gives_the_claim_back(tmp_path: Path) -> None:
    target = tmp_path / "0001.png"
    with pytest.raises(RuntimeError), claimed(target):
        raise RuntimeError
    assert not claim_of(target).exists()


def dead_process() -> int:
    child = subprocess.Popen([sys.executable, "-c", "pass"])
    child.wait()
    return child.pid


@pytest.mark.parametrize(
    ("host", "is_dead", "age", "is_taken"),
    [
        ("here", True, 0.0, True),
        ("here", False, 1e6, False),
        ("elsewhere", True, 0.0, False),
        ("elsewhere", True, 1e6, True),
    ],
)
def test_whose_claim_is_taken_over(host: str, is_dead: bool, age: float, is_taken: bool, tmp_path: Path) -> None:
    target = tmp_path / "0001.png"
    name = socket.gethostname() if host == "here" else "another-machine"
    pid = dead_process() if is_dead else os.getpid()
    claim_of(target).write_text(json.dumps({"host": name, "pid": pid, "start": None}))
    now = claim_of(target).stat().st_mtime
    os.utime(claim_of(target), (now - age, now - age))
    with claimed(target) as is_ours:
        assert is_ours is is_taken


@pytest.mark.parametrize(("age", "is_taken"), [(0.0, False), (100.0, True)])
def test_an_empty_claim_is_waited_for_and_then_taken(age: float, is_taken: bool, tmp_path: Path) -> None:
    target = tmp_path / "0001.png"
    claim_of(target).write_text("")
    now = claim_of(target).stat().st_mtime
    os.utime(claim_of(target), (now - age, now - age))
    with claimed(target) as is_ours:
        assert is_ours is is_taken


def output_of_workers(folder: Path, body: str) -> list[str]:
    """The lines that four processes print which run `body` at once, with `folder` the path of one folder."""
    program = f"""
import os, sys
from pathlib import Path
sys.path.insert(0, {str(CHECKOUT)!r})
from synthetic.claims import claimed, write_once
folder = Path({str(folder)!r})
{textwrap.dedent(body)}"""
    children = [subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) for _ in range(4)]
    lines = [line for child in children for line in child.communicate()[0].splitlines()]
    assert all(child.returncode == 0 for child in children)
    assert not list(folder.glob("*.claim*")) and not list(folder.glob("*.part"))
    return lines


def test_many_workers_make_every_file_exactly_once(tmp_path: Path) -> None:
    """Four processes over forty files, each second one left behind with a dead worker's claim."""
    stale = json.dumps({"host": socket.gethostname(), "pid": dead_process(), "start": None})
    for index in range(0, 40, 2):
        claim_of(tmp_path / f"{index}").write_text(stale)
    body = """
        for index in range(40):
            target = folder / str(index)
            with claimed(target) as is_ours:
                if is_ours:
                    with open(target, "x") as file:
                        file.write(str(os.getpid()))
                    print(index)
    """
    assert sorted(output_of_workers(tmp_path, body), key=int) == [str(index) for index in range(40)]


def test_workers_that_write_one_text_at_once_all_read_the_same(tmp_path: Path) -> None:
    body = """
        for index in range(200):
            print(index, write_once(folder / str(index), str(os.getpid())))
    """
    lines = output_of_workers(tmp_path, body)
    assert len(lines) == 800
    assert set(lines) == {f"{index} {(tmp_path / str(index)).read_text()}" for index in range(200)}


def test_a_text_that_another_worker_is_at_is_waited_for(tmp_path: Path) -> None:
    target = tmp_path / "render.json"
    with claimed(target) as is_ours, ThreadPoolExecutor() as pool:
        assert is_ours
        reader = pool.submit(write_once, target, "mine")
        time.sleep(0.1)
        assert not reader.done()
        target.write_text("another's")
        assert reader.result(timeout=10) == "another's"
