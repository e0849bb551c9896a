"""How long a movement takes: acceleration, constant speed, braking."""

from __future__ import annotations

import math

from rigs.errors import ConfigError


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


def range_within(
    wanted_mm: tuple[float, float] | None, own_mm: tuple[float, float], *, slack_mm: float, whose: str, mend: str
) -> tuple[float, float]:
    """Positions that may be commanded: those of the configuration, which have to lie within the controller's own.

    Parameters
    ----------
    wanted_mm
        ``stage.limits`` of the configuration; None: all of the travel.
    own_mm
        Travel as the controller says it.
    slack_mm
        By so much a limit may differ from the controller's and still mean the same.
    whose, mend
        Whose travel it is, and what besides rig.yaml may be wrong; for the message.

    Raises
    ------
    ConfigError
        The wanted range reaches beyond the travel.
    """
    if wanted_mm is None:
        return own_mm
    (low, high), (own_low, own_high) = wanted_mm, own_mm
    if low < own_low - slack_mm or high > own_high + slack_mm:
        raise ConfigError(
            f"stage.limits: {low:g} to {high:g} mm reach beyond {whose}, {own_low:g} to {own_high:g} mm; correct "
            f"stage.limits in rig.yaml, or {mend}"
        )
    return max(low, own_low), min(high, own_high)
