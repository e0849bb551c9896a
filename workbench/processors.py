"""How many processors there are to use, and work shared out among them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def usable_processors() -> int:
    """Processors that this process may run on, at least 1; fewer than the machine has where it was bound to some."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def each(work: Callable[[Item], Result], items: Iterable[Item], workers: int) -> list[Result]:
    """``work`` on every item, so many at once, in threads; results in the items' order.

    Of use where the work is done by libraries and compiled loops, which leave Python's lock. An error ends it.
    """
    listed = list(items)
    if min(workers, len(listed)) <= 1:
        return [work(item) for item in listed]
    with ThreadPoolExecutor(min(workers, len(listed))) as pool:
        return list(pool.map(work, listed))
