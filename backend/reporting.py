"""What a stage may say while it works. The pipeline gives each stage one of these."""

from __future__ import annotations

from typing import Protocol


class Report(Protocol):
    """Progress, warnings and cancellation of one stage."""

    def progress(self, step: int, total: int, **metrics: float) -> None:
        """`step` of `total` steps are done. Raises contract.errors.Cancelled when the user asked to stop."""
        ...

    def warning(self, code: str, message: str) -> None:
        """Something the user should know; the work goes on. code is snake_case and stable."""
        ...


class SilentReport:
    """For tests and scripts: keeps the warnings, forgets the rest."""

    def __init__(self) -> None:
        self.warnings: list[tuple[str, str]] = []

    def progress(self, step: int, total: int, **metrics: float) -> None:
        del step, total, metrics

    def warning(self, code: str, message: str) -> None:
        self.warnings.append((code, message))
