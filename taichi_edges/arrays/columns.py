"""Columns: arrays of equal length that belong together, with a row for each of the things they describe."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

SomeColumns = TypeVar("SomeColumns", bound="Columns")


@dataclass(frozen=True)
class Columns:
    """Base of frozen dataclasses whose fields are columns: arrays with a row for each thing, or Columns themselves.

    A field that is neither, such as None or a number, is about all rows alike.
    """

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def keep(self: SomeColumns, chosen: np.ndarray | slice) -> SomeColumns:
        """Only the chosen rows. chosen: (n,) bool or indices."""
        return replace(self, **{field.name: _rows(getattr(self, field.name), chosen) for field in fields(self)})

    @classmethod
    def joined(cls: type[SomeColumns], parts: Sequence[SomeColumns]) -> SomeColumns:
        """The rows of some parts, at least one, one after the other; what is about all rows is the same in each."""
        return cls(**{field.name: _joined([getattr(part, field.name) for part in parts]) for field in fields(cls)})


def _rows(column: Any, chosen: np.ndarray | slice) -> Any:
    if isinstance(column, Columns):
        return column.keep(chosen)
    return column[chosen] if isinstance(column, np.ndarray) else column


def _joined(columns: Sequence[Any]) -> Any:
    first = columns[0]
    if isinstance(first, Columns):
        return type(first).joined(columns)
    if isinstance(first, np.ndarray):
        return np.concatenate(columns)
    assert all(column == first for column in columns), columns
    return first
