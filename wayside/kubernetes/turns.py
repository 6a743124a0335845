"""A queue that is fair by namespace: namespaces take turns, so a flood of items in one delays no other."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Turns(Generic[Item]):
    """Items in the order in which their turns come."""

    def __init__(self) -> None:
        self._waiting: OrderedDict[str, deque[Item]] = OrderedDict()  # the first has the next turn

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def __contains__(self, namespace: str) -> bool:
        return namespace in self._waiting

    def count(self, namespace: str) -> int:
        """How many items of the namespace wait."""
        return len(self._waiting.get(namespace, ()))

    def add(self, namespace: str, item: Item) -> None:
        """Put an item behind the others of its namespace."""
        self._waiting.setdefault(namespace, deque()).append(item)

    def next(self, may: Callable[[str], bool] = lambda _: True) -> Item | None:
        """Take the next item out of the namespaces that may have a turn; None where none waits in any of these."""
        taken = self.take(may)
        return None if taken is None else taken[1]

    def take(self, may: Callable[[str], bool]) -> tuple[str, Item] | None:
        """The same, with its namespace."""
        for namespace, items in self._waiting.items():
            if may(namespace):
                item = items.popleft()
                if items:
                    self._waiting.move_to_end(namespace)
                else:
                    del self._waiting[namespace]
                return namespace, item
        return None
