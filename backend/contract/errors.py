"""One error type for everything that the user can act on, and the exit codes of the command line."""

from __future__ import annotations

EXIT_DONE = 0  # finished, or cancelled on request
EXIT_DEFECT = 1  # a bug: traceback in log.txt
EXIT_USER = 2  # the user can act: one sentence on what, one on how


class BackendError(Exception):
    """Something is wrong that the user can mend: what it is, and what to do about it.

    code: short stable name in snake_case, for programs; message: one sentence on what is wrong;
    hint: one sentence on what to do; stage: the stage it happened in, filled in by the pipeline.
    """

    def __init__(self, code: str, message: str, *, hint: str, stage: str | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.hint = hint
        self.stage = stage

    def __str__(self) -> str:
        return f"{self.message} {self.hint}"


class Cancelled(Exception):
    """The user asked to stop. Raised between two steps; what was computed is kept."""
