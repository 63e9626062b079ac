"""Scratch of the workers, which each thread of the host keeps until memory is short."""

import threading
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakSet


@dataclass(eq=False)
class Kept:
    """The scratch of one thread of the host; any other may take it away.

    arrays: By what they are for: how many there are, their shapes, and the arrays.
    """

    arrays: dict[str, tuple[int, list[Any], list[Any]]] = field(default_factory=dict)


class Scratch:
    """The scratch of all threads of the host; what a thread kept goes with it."""

    def __init__(self) -> None:
        self._thread, self._all = threading.local(), WeakSet[Kept]()
        self._changing = threading.Lock()

    def of_this_thread(self) -> Kept:
        """What the calling thread keeps."""
        if not hasattr(self._thread, "kept"):
            self._thread.kept = Kept()
            with self._changing:
                self._all.add(self._thread.kept)
        kept: Kept = self._thread.kept
        return kept

    def give_up(self) -> bool:
        """Keep nothing, of any thread: whether there was anything.

        What is in use stays until it is no longer.
        """
        with self._changing:
            holding = [kept for kept in self._all if kept.arrays]
        for kept in holding:
            kept.arrays = {}
        return bool(holding)
