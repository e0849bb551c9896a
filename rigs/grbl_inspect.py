"""What a check of the rig wants to know about a GRBL controller: read only, nothing moves, nothing is homed."""

from __future__ import annotations

from dataclasses import replace

from rigs.grbl_controller import GrblController
from rigs.grbl_machine import GrblMachine, read_machine
from rigs.grbl_moves import NOT_READY
from rigs.grbl_protocol import Status
from rigs.grbl_stage import GrblSettings
from rigs.protocols import DeviceIdentity
from rigs.serial_link import SerialLink
from rigs.stage_facts import StageFacts

_ANSWERS_SETTINGS = ("Idle", "Alarm")
_MOTORS_STAY_ON = 255
_DOOR_CLOSED_AGAIN = 0


def inspect_grbl(settings: GrblSettings) -> StageFacts:
    """Open the port, ask, close it again. Unlike the driver this takes controllers without homing or soft limits too.

    Raises
    ------
    ConfigError, DeviceNotFoundError, DeviceBusyError, DeviceTimeoutError, ProtocolError
        Nothing there, somebody else's, silent, or no GRBL.
    StageError
        Its settings make no sense.
    """
    link = SerialLink(settings.port, settings.baud_rate)
    try:
        controller = GrblController(
            link, reply_timeout_s=settings.reply_timeout_s, boot_timeout_s=settings.boot_timeout_s
        )
        status = controller.wake()
        if status.state not in _ANSWERS_SETTINGS:
            return _busy(settings, status)
        machine = read_machine(controller, settings.axis)
        status = controller.status("looking at it")
    finally:
        link.close()
    return StageFacts(
        identity=_identity(settings, machine.model, machine.firmware),
        state=status.state,
        referenced=False,  # opening the port may have reset it: the driver homes on every connection
        problem=_problem(status, machine),
        remarks=_remarks(status, machine, settings, was_deaf=controller.was_deaf),
        homing=machine.homing,
        soft_limits=machine.soft_limits,
        hard_limits=machine.hard_limits,
        travel_mm=machine.limits_mm,
        max_speed_mm_s=machine.max_speed_mm_s,
    )


def _identity(settings: GrblSettings, model: str, firmware: str = "") -> DeviceIdentity:
    return DeviceIdentity(kind="grbl", model=model, firmware=firmware, extra={"port": settings.port})


def _busy(settings: GrblSettings, status: Status) -> StageFacts:
    """What is known of a controller that doesn't tell its settings in this state."""
    _, what, way_out = NOT_READY[status.state]
    facts = StageFacts(identity=_identity(settings, "GRBL"), state=status.state, referenced=False)
    if status.state == "Door" and status.substate != _DOOR_CLOSED_AGAIN:
        return replace(facts, problem=(f"the controller {what}", "close the door"))
    if status.state == "Door":
        what = "stopped for its safety door, which is closed again"
    return replace(facts, disturbance=(f"the controller {what}: calibrate ends that", way_out))


def _problem(status: Status, machine: GrblMachine) -> tuple[str, str] | None:
    if status.state == "Alarm" and not machine.homing:
        return (
            "the controller is in alarm, and can't be homed out of it",
            "switch it off and on, or set $22=1",
        )
    return None


def _remarks(
    status: Status, machine: GrblMachine, settings: GrblSettings, *, was_deaf: bool
) -> tuple[tuple[str, str, str], ...]:
    remarks = []
    if was_deaf:
        remarks.append(
            (
                "last alarm",
                "the controller was deaf until it was reset, as after running into a limit switch or a soft limit",
                "look why, and whether the carriage runs free; the next calibration homes it",
            )
        )
    if settings.axis in status.pins:
        remarks.append(
            (
                "limit switch",
                f"the one of axis {settings.axis} is closed",
                "right if the carriage stands at its switch; else check the switch and its cable ($5 inverts it)",
            )
        )
    if machine.settings.get(1, "").isdigit() and int(machine.settings[1]) != _MOTORS_STAY_ON:
        remarks.append(
            (
                "motors",
                f"switched off {machine.settings[1]} ms after each move ($1)",
                "$1=255 keeps them on, so that belt and cables can't pull the carriage away during an exposure",
            )
        )
    return tuple(remarks)
