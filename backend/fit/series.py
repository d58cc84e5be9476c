"""Frames or records by number, wherever they lie: a list, a stack on disk, a folder that is being filled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

Item = TypeVar("Item", covariant=True)


class Series(Protocol[Item]):
    """Read again and again by number, 0 to len - 1; IndexError beyond."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Item: ...


@dataclass(frozen=True, slots=True)
class First(Generic[Item]):
    """The first `count` of a series, as if there were no more."""

    series: Series[Item]
    count: int

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int, /) -> Item:
        if not 0 <= index < self.count:
            raise IndexError(index)
        return self.series[index]
