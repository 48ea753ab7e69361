"""Handing the newest item from one thread to another."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Newest(Generic[Item]):
    """A place for one item: who takes always gets the newest, and what nobody took in time is dropped.

    Attributes
    ----------
    dropped : number of items so far that were replaced before anybody took them.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._changed = threading.Condition()
        self._item: Item | None = None
        self._ended = False
        self._error: BaseException | None = None

    def put(self, item: Item) -> None:
        """Leave an item, in place of one that is there still; never waits for a taker."""
        with self._changed:
            self.dropped += self._item is not None
            self._item = item
            self._changed.notify_all()

    def end(self, error: BaseException | None = None) -> None:
        """No more will come; takers get ``error``, if any, when nothing is left."""
        with self._changed:
            self._ended, self._error = True, error
            self._changed.notify_all()

    def take(self) -> Item | None:
        """Wait for an item and take it; None when no more will come.

        Raises
        ------
        BaseException
            The error with which the items ended.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._ended)
            item, self._item = self._item, None
            if item is None and self._error is not None:
                raise self._error
            return item
