"""How long a movement takes: acceleration, constant speed, braking."""

from __future__ import annotations

import math


def move_time_s(distance_mm: float, speed_mm_s: float, acceleration_mm_s2: float) -> float:
    """Duration of a move from rest to rest with a trapezoidal profile of speed.

    Parameters
    ----------
    distance_mm
        Way to go; its sign doesn't matter.
    speed_mm_s, acceleration_mm_s2
        Limits, above zero.

    Returns
    -------
    float
        Seconds. A way that is too short to reach full speed makes a triangle: ``2 * sqrt(distance / acceleration)``.
    """
    distance_mm = abs(distance_mm)
    if distance_mm < speed_mm_s**2 / acceleration_mm_s2:
        return 2.0 * math.sqrt(distance_mm / acceleration_mm_s2)
    return distance_mm / speed_mm_s + speed_mm_s / acceleration_mm_s2


def braking_time_s(speed_mm_s: float, acceleration_mm_s2: float) -> float:
    """Seconds from full speed to rest."""
    return speed_mm_s / acceleration_mm_s2
