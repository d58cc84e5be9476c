"""What is settled before numba loads."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from backend import kernel_setup

CHECKOUT = Path(__file__).resolve().parents[2]
PROBE = "import backend.render.splat, os, numba; print(os.environ['OMP_WAIT_POLICY'], numba.config.CACHE_DIR, \
numba.config.THREADING_LAYER_PRIORITY[0])"


def probe(**changes: str) -> list[str]:
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), **changes}
    for name in ("OMP_WAIT_POLICY", "NUMBA_CACHE_DIR", "NUMBA_THREADING_LAYER_PRIORITY"):
        if name not in changes:
            environment.pop(name, None)
    return subprocess.run(
        [sys.executable, "-c", PROBE], env=environment, capture_output=True, text=True, check=True
    ).stdout.split()


def test_settled_before_numba_reads_it(tmp_path: Path) -> None:
    policy, folder, threads_by = probe(XDG_CACHE_HOME=str(tmp_path))
    assert policy == "passive"
    assert threads_by == "omp"
    assert folder.endswith(f"wildsmoke/kernels-{kernel_setup.sources_fingerprint()}")


def test_the_users_own_settings_stand(tmp_path: Path) -> None:
    own = {"OMP_WAIT_POLICY": "active", "NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_THREADING_LAYER_PRIORITY": "workqueue omp tbb"}
    assert probe(**own) == ["active", str(tmp_path), "workqueue"]


def test_another_source_is_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in kernel_setup.KERNEL_FOLDERS:
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "kernels.py").write_text("a = 1\n")
    monkeypatch.setattr(kernel_setup, "__file__", str(tmp_path / "kernel_setup.py"))
    before = kernel_setup.sources_fingerprint()
    (tmp_path / "physics" / "kernels.py").write_text("a = 2\n")
    assert kernel_setup.sources_fingerprint() != before


@pytest.mark.skipif(sys.platform != "linux", reason="the folder is named by another variable there")
def test_old_machine_code_is_cleared_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    old, recent = (tmp_path / "wildsmoke" / f"kernels-{name}" for name in ("old", "recent"))
    for folder in (old, recent):
        folder.mkdir(parents=True)
    long_ago = time.time() - 2 * kernel_setup.KEPT_SECONDS
    os.utime(old, (long_ago, long_ago))
    kernel_setup.cache_folder()
    assert not old.exists()
    assert recent.exists()
