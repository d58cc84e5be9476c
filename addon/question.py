"""Something that the backend's Python is asked, in a process of its own and a thread of its own. Without bpy."""

from __future__ import annotations

import contextlib
import subprocess
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from .job_runner import Backend, group_options, signal_group

Answer = TypeVar("Answer")


class Question(Generic[Answer]):
    """poll() gives the answer once it is there; close() ends the asking.

    read: the answer from what the process wrote to its output and to its errors. failed: the answer where there was none,
    from a sentence that says why.
    """

    def __init__(
        self,
        backend: Backend,
        command: list[str],
        *,
        seconds: float,  # until it is given up
        read: Callable[[bytes, bytes], Answer],
        failed: Callable[[str], Answer],
    ) -> None:
        self._python, self._seconds = backend.python, seconds
        self._read, self._failed = read, failed
        self._process: subprocess.Popen[bytes] | None = None
        self._answer: Answer | None = None
        self._thread = threading.Thread(target=self._work, name="wildsmoke-question", daemon=True)
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                cwd=backend.root,
                env=backend.environment(),
                **group_options(),
            )
        except OSError as error:
            self._answer = failed(f"{backend.python} cannot be started: {error.strerror or error}")
            return
        self._thread.start()

    def _work(self) -> None:
        process = self._process
        assert process is not None
        try:
            output, errors = process.communicate(timeout=self._seconds)
        except subprocess.TimeoutExpired:
            signal_group(process, force=True)
            process.communicate()
            self._answer = self._failed(f"{self._python} gave no answer within {self._seconds:.0f} s")
            return
        self._answer = self._read(output, errors)

    def poll(self) -> Answer | None:
        """The answer, None while it is not there. Never waits."""
        return self._answer

    def wait(self) -> Answer:
        """The answer, waited for: for Blender in background mode."""
        if self._thread.is_alive():
            self._thread.join()
        assert self._answer is not None
        return self._answer

    def close(self) -> None:
        """End the asking."""
        if self._process is not None and self._process.poll() is None:
            signal_group(self._process, force=True)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)
