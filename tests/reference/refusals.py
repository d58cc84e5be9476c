"""Whether bad input is answered with a sentence."""

from __future__ import annotations

from collections.abc import Callable

from backend.contract.errors import BackendError


def refuses(action: Callable[[], object], name: str) -> bool:
    """Whether the action ends in a ValueError whose text holds `name`: which input it was."""
    try:
        action()
    except ValueError as error:
        return name in str(error)
    return False


def told(action: Callable[[], object]) -> BackendError | None:
    """What the user is told; None where the action went through. A sentence on what is wrong, and one on how to mend it."""
    try:
        action()
    except BackendError as error:
        is_whole = error.code.isidentifier() and error.message.endswith((".", "!")) and error.hint.endswith(".")
        if not is_whole:
            raise ValueError(f"{error.code}: {error.message!r} {error.hint!r} are no two sentences") from error
        return error
    return None
