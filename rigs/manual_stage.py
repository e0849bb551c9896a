"""A stage that is moved by hand: the operator is asked to move the panel, and confirms.

Labs without a rail calibrate this way. The position is what the operator says: Enter confirms the one that was asked
for, a length says where the panel really stands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rigs.errors import ConfigError, LimitError, NotHomedError, StageError
from rigs.protocols import DeviceIdentity

Ask = Callable[[str], str]
"""Shows a question, returns the operator's answer without its line end; raises EOFError where nobody can answer."""

_SECONDS_PER_MOVE = 30.0
_TRIES = 3
_SAME_MM = 1.0
"""Two depths nearer to each other than this are one: nobody reads a tape measure better."""


def _millimetres(text: str) -> float:
    return float(text.removesuffix("mm"))


@dataclass(frozen=True, slots=True)
class ManualSettings:
    """Where the panel may stand.

    Attributes
    ----------
    limits_mm
        Smallest and largest position.
    describe
        Turns a position (mm) into the words that the operator reads, e.g. ``120 cm``.
    read
        Turns such words back into a position (mm); raises ValueError where they are none.
    """

    limits_mm: tuple[float, float]
    describe: Callable[[float], str] = "{:g} mm".format
    read: Callable[[str], float] = _millimetres


class ManualStage:
    """A panel that is carried by hand (see :class:`rigs.protocols.Stage`)."""

    def __init__(self, settings: ManualSettings, ask: Ask) -> None:
        low, high = settings.limits_mm
        if not low < high:
            raise ConfigError(f"stage.limits: {low:g} to {high:g} mm is no range; give the smaller one first")
        self._settings, self._ask = settings, ask
        self._position_mm: float | None = None
        self._stood: dict[float, float] = {}
        """Where it stood for each position that was asked for."""

    def identify(self) -> DeviceIdentity:
        """Kind only: there is no controller."""
        return DeviceIdentity(kind="manual", model="moved by hand")

    def homed(self) -> bool:
        """Always: every position is confirmed by the operator."""
        return True

    def home(self) -> None:
        """Nothing to find."""

    def position_mm(self) -> float:
        """Position that the operator confirmed last.

        Raises
        ------
        NotHomedError
            Not moved yet.
        """
        if self._position_mm is None:
            raise NotHomedError("stage: where the panel stands isn't known before its first move")
        return self._position_mm

    def limits_mm(self) -> tuple[float, float]:
        """Range of positions."""
        return self._settings.limits_mm

    def move_to_mm(self, position_mm: float) -> float:
        """Ask the operator to move the panel; returns the position that was confirmed.

        Raises
        ------
        LimitError
            The position that was asked for is out of range.
        StageError
            Nobody can answer, or the answers make no sense.
        """
        self._check(position_mm)
        asked = self._settings.describe(position_mm)
        question = f"Move the panel to {asked} and press Enter (or type where it really stands, e.g. {asked}): "
        again = f"press Enter for {asked}, or type where it stands: "
        for _ in range(_TRIES):
            try:
                answer = self._ask(question).strip()
            except EOFError:
                raise StageError(
                    "stage: nobody answers here (end of input); run a manual stage from a terminal"
                ) from None
            try:
                stands_mm = self._settings.read(answer) if answer else position_mm
                self._check(stands_mm)
            except ValueError:
                question = f"{answer!r} is no length; {again}"
            except LimitError:
                low, high = map(self._settings.describe, self._settings.limits_mm)
                question = f"{answer} isn't between {low} and {high}; {again}"
            else:
                if answer and self._stood_there_before(stands_mm, position_mm):
                    question = (
                        f"it stood at {answer} for another depth already; move it to {asked} and press Enter, "
                        "or type where it stands: "
                    )
                    continue
                self._position_mm = self._stood[position_mm] = stands_mm
                return stands_mm
        raise StageError("stage: no usable answer; read the tape measure and answer again")

    def _stood_there_before(self, stands_mm: float, asked_mm: float) -> bool:
        return any(
            abs(stood - stands_mm) < _SAME_MM
            for other, stood in self._stood.items()
            if abs(other - asked_mm) >= _SAME_MM
        )

    def _check(self, position_mm: float) -> None:
        low, high = self._settings.limits_mm
        if not low - 1e-6 <= position_mm <= high + 1e-6:
            raise LimitError(
                f"stage: {position_mm:g} mm is outside stage.limits ({low:g} to {high:g} mm); "
                "correct rig.yaml or the plan"
            )

    def travel_time_s(self, distance_mm: float) -> float:
        """What a person takes."""
        return _SECONDS_PER_MOVE if distance_mm else 0.0

    def stop(self) -> None:
        """Nothing moves by itself."""

    def close(self) -> None:
        """Nothing to release."""
