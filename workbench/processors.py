"""How many processors there are to use."""

from __future__ import annotations

import os


def usable_processors() -> int:
    """Processors that this process may run on, at least 1; fewer than the machine has where it was bound to some."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1
