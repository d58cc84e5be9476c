"""Frames or records by number, wherever they lie: a list, a stack on disk, a folder that is being filled."""

from __future__ import annotations

from typing import Protocol, TypeVar

Item = TypeVar("Item", covariant=True)


class Series(Protocol[Item]):
    """Read again and again by number, 0 to len - 1; IndexError beyond."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Item: ...
