"""How long work tells its observer where it stands; who shows it, and how, is the command line's business."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Step:
    """Where long work stands."""

    message: str
    done: int
    total: int
    seconds_left: float | None = None


Observer = Callable[[Step], None]
