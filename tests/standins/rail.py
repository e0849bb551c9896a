"""A rail as metal: a carriage, a reference switch at the low end, and what motors do to them."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Trapezoid:
    """A move from rest to rest: speed up, go, brake. Lengths mm, times s."""

    start_s: float
    start_mm: float
    target_mm: float
    speed: float
    acceleration: float

    @property
    def _peak(self) -> float:
        return min(self.speed, math.sqrt(abs(self.target_mm - self.start_mm) * self.acceleration)) or 1e-9

    @property
    def end_s(self) -> float:
        distance = abs(self.target_mm - self.start_mm)
        return self.start_s + distance / self._peak + self._peak / self.acceleration if distance else self.start_s

    def at(self, now_s: float) -> tuple[float, float]:
        """Position and signed speed."""
        sign = math.copysign(1.0, self.target_mm - self.start_mm)
        t, total, ramp = now_s - self.start_s, self.end_s - self.start_s, self._peak / self.acceleration
        if t >= total:
            return self.target_mm, 0.0
        if t < ramp:
            return self.start_mm + sign * self.acceleration * t**2 / 2, sign * self.acceleration * t
        left = total - t
        if left < ramp:
            return self.target_mm - sign * self.acceleration * left**2 / 2, sign * self.acceleration * left
        return self.start_mm + sign * self._peak * (t - ramp / 2), sign * self._peak


@dataclass(frozen=True)
class Braking:
    """From a speed to rest; the firmware notices the end when its segment buffer has run dry."""

    start_s: float
    start_mm: float
    speed: float
    acceleration: float
    segments_s: float = 0.06

    @property
    def end_s(self) -> float:
        return self._rest_s + self.segments_s

    @property
    def _rest_s(self) -> float:
        return self.start_s + abs(self.speed) / self.acceleration

    def at(self, now_s: float) -> tuple[float, float]:
        sign = math.copysign(1.0, self.speed)
        t = min(now_s, self._rest_s) - self.start_s
        speed = self.speed - sign * self.acceleration * t
        position = self.start_mm + self.speed * t - sign * self.acceleration * t**2 / 2
        return position, speed if now_s < self._rest_s else 0.0


Motion = Trapezoid | Braking


@dataclass
class Rail:
    """Where the carriage really is; the controller only counts steps."""

    carriage_mm: float = 2905.0
    switch_at_mm: float = 5.0
    jammed: bool = False
    stuck_switch: bool = False
    dead_switch: bool = False

    def push(self, by_mm: float) -> None:
        if not self.jammed:
            self.carriage_mm = max(0.0, self.carriage_mm + by_mm)

    @property
    def way_to_switch_mm(self) -> float:
        blind = self.jammed or self.dead_switch or self.carriage_mm <= self.switch_at_mm
        return -math.inf if blind else self.switch_at_mm - self.carriage_mm

    @property
    def switch_closed(self) -> bool:
        if self.dead_switch:
            return False
        return self.stuck_switch or self.carriage_mm <= self.switch_at_mm + 1e-6
