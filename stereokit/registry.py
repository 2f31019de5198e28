"""Tables of stages by name: costs, aggregations and refiners, with plug-ins from entry points.

Listing names imports nothing; a plug-in is imported at its first use.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

from stereokit.errors import OptionError, UnknownNameError, did_you_mean, shown

__all__ = ["AGGREGATIONS", "COSTS", "REFINERS", "Registry"]

T = TypeVar("T")


class Registry(Generic[T]):
    """A table from lower-case names to stages.

    Parameters
    ----------
    kind : str
        What the names stand for, used in messages: ``"cost"``.
    group : str
        Entry-point group in which other packages announce theirs.
    """

    def __init__(self, kind: str, group: str) -> None:
        self.kind = kind
        self.group = group
        self._items: dict[str, T] = {}

    def register(self, name: str) -> Callable[[T], T]:
        """Return a decorator that registers its object under `name` (any case, no ``+``).

        Raises
        ------
        OptionError
            If the name is empty, contains ``+`` or is taken.
        """
        key = name.lower()
        if not key or "+" in key:
            raise OptionError(f"{self.kind} name must be non-empty and without '+', got {name!r}")
        if key in self._items:
            raise OptionError(f"{self.kind} {key!r} is already registered; names must be unique")

        def add(item: T) -> T:
            self._items[key] = item
            return item

        return add

    def get(self, name: str) -> T:
        """Return the stage of that name, importing its plug-in if it comes from one.

        Raises
        ------
        UnknownNameError
            If nothing has that name.
        """
        if not isinstance(name, str):
            raise OptionError(f"{self.kind} must be a name, got {shown(name)}")
        key = name.lower()
        if key not in self._items:
            for entry in self._entries():
                if entry.name.lower() == key:
                    self._items[key] = entry.load()
                    break
            else:
                raise UnknownNameError(did_you_mean(self.kind, name, self.names()))
        return self._items[key]

    def names(self) -> tuple[str, ...]:
        """Return all known names, sorted, without importing any plug-in."""
        return tuple(sorted({*self._items, *(entry.name.lower() for entry in self._entries())}))

    def _entries(self) -> Any:
        return entry_points(group=self.group)


COSTS: Registry[Any] = Registry("cost", "stereokit.costs")
AGGREGATIONS: Registry[Any] = Registry("aggregation", "stereokit.aggregations")
REFINERS: Registry[Any] = Registry("refiner", "stereokit.refiners")
