"""What a check of the rig wants to know about a stage's controller: read only, nothing moves."""

from __future__ import annotations

from dataclasses import dataclass

from rigs.protocols import DeviceIdentity


@dataclass(frozen=True, slots=True)
class StageFacts:
    """A controller as it was found; lengths mm, None where it doesn't say.

    Attributes
    ----------
    identity
        Make, model, firmware and serial number.
    state
        As the controller says it (``Idle``, ``Alarm``), for people.
    referenced
        Whether the controller vouches for its position now. False is usual before a session: it homes first.
    problem
        Why it can't be homed or moved, and the way out; None: nothing speaks against it.
    disturbance
        What it is doing that a session would end, and the way out.
    remarks
        What is odd without stopping it: name, what was seen, the way out.
    homing, soft_limits, hard_limits
        Whether the controller finds a reference, refuses targets outside its travel, and heeds limit switches.
    travel_mm
        Smallest and largest position that the controller allows.
    max_speed_mm_s
        Its own speed limit (mm/s).
    """

    identity: DeviceIdentity
    state: str
    referenced: bool
    problem: tuple[str, str] | None = None
    disturbance: tuple[str, str] | None = None
    remarks: tuple[tuple[str, str, str], ...] = ()
    homing: bool | None = None
    soft_limits: bool | None = None
    hard_limits: bool | None = None
    travel_mm: tuple[float, float] | None = None
    max_speed_mm_s: float | None = None
