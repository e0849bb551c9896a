"""Questions to one Zaber device on a line that others may share, and the answers that belong to them."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable
from contextlib import suppress

from rigs.errors import (
    ConfigError,
    DeviceTimeoutError,
    LimitError,
    ProtocolError,
    RigError,
    StoppedError,
)
from rigs.serial_link import SerialLink
from rigs.zaber_protocol import Reply, continued, is_unasked, parse, rejection, request

_TRIES = 2
"""A message may be lost or damaged on its way; every command of ours may be sent twice, for its target is absolute."""
_OTHERS_S = 0.15
"""How long other devices may take to answer the same question."""


class ZaberLine:
    """A device behind a line. Any thread may ask; one question at a time is under way.

    Parameters
    ----------
    link
        The open line; closed with this.
    device, axis
        Address in the chain, and axis of the controller.
    reply_timeout_s
        How long an answer may take.
    """

    def __init__(self, link: SerialLink, device: int, axis: int, *, reply_timeout_s: float) -> None:
        self._link, self._device, self._axis, self._reply_timeout_s = link, device, axis, reply_timeout_s
        self._asking = threading.Lock()
        self._message_ids = itertools.cycle(range(100))

    def close(self) -> None:
        """Close the line; safe to call twice."""
        self._link.close()

    def send(self, command: str) -> None:
        """Send a command now, whoever waits for what, and don't wait for its answer."""
        self._link.write(request(self._device, self._axis, self._next_id(), command))

    def ask(self, command: str, *, axis: int | None = None, unless: Callable[[], bool] = lambda: False) -> Reply:
        """Send a command and wait for the reply that bears its number.

        Parameters
        ----------
        command
            As in the protocol manual; empty: how it is.
        axis
            Another one than the stage's; 0 is the whole device.
        unless
            Asked before it is sent: True withholds it.

        Raises
        ------
        DeviceTimeoutError, ProtocolError
            No answer; none that is whole.
        StoppedError
            It was withheld.
        RigError
            It was rejected; the kind follows from the reason.
        """
        axis = self._axis if axis is None else axis
        heard: list[str] = []
        with self._asking:
            for _ in range(_TRIES):
                message_id = self._next_id()
                if not self._link.write(request(self._device, axis, message_id, command), unless=unless):
                    raise StoppedError("stage: stopped before it moved")
                reply = self._await(axis, message_id, heard)
                if reply is not None:
                    if not reply.accepted:
                        raise rejection(command, reply.data.split(" ")[0])
                    return reply
        raise self._no_reply(command, heard)

    def busy(self) -> bool:
        """Whether it moves."""
        return self.ask("").busy

    def flags(self) -> frozenset[str]:
        """All warnings; a reply's own field shows only the most important one."""
        data = ""
        for _ in range(_TRIES):
            data = self.ask("warnings").data
            count, *flags = data.split() or [""]
            if count.isdigit() and int(count) == len(flags):
                return frozenset(flags)
        raise ProtocolError(f"stage: the list of warnings is damaged ({data[:60]!r}); check the cable, then try again")

    def latest(self, setting: str) -> float:
        """A number that may be another one next time."""
        data = self.ask(f"get {setting}").data
        try:
            return float(data.split()[0])
        except (ValueError, IndexError):
            raise ProtocolError(f"stage: {setting} is {data!r}, no number; check cable and stage.kind") from None

    def number(self, setting: str) -> float:
        """A number from two equal answers: travel and scale hang on it, and noise may change a digit."""
        previous = None
        for _ in range(4):
            value = self.latest(setting)
            if value == previous:
                return value
            previous = value
        raise ProtocolError(f"stage: {setting} reads otherwise each time; check cable and ground, then try again")

    def optional(self, setting: str, axis: int) -> float | None:
        """A number that not every device has."""
        text = self.text(setting, axis)
        return self.number(setting) if text.replace(".", "", 1).isdigit() else None

    def text(self, setting: str, axis: int = 0) -> str:
        """A setting that not every device has; empty where it hasn't."""
        with suppress(ProtocolError, LimitError, ConfigError):
            return self.ask(f"get {setting}", axis=axis).data
        return ""

    def require_one_device(self) -> None:
        """Make sure that there is a device of this address, and no second one that would obey the same commands.

        Raises
        ------
        ProtocolError
            Others answer, or two do.
        DeviceTimeoutError
            Nobody does.
        """
        try:
            own = self.ask("", axis=0)
        except DeviceTimeoutError:
            others = sorted({reply.device for reply in self._all_replies(0, "")})
            if others:
                raise self._wrong_address(others) from None
            raise
        serials = {reply.data for reply in self._all_replies(own.device, "get system.serial") if reply.accepted}
        if len(serials) > 1:
            raise ProtocolError(
                f"stage: {len(serials)} devices answer as device {own.device} (serial numbers "
                f"{', '.join(sorted(serials))}) and would all move; give each its own address in Zaber Launcher "
                "(renumber)"
            )

    def _all_replies(self, device: int, command: str) -> list[Reply]:
        """Ask one device, or with 0 all, and listen until nobody answers any more."""
        replies: list[Reply] = []
        with self._asking:
            message_id = self._next_id()
            self._link.write(request(device, 0, message_id, command))
            end = time.monotonic() + self._reply_timeout_s
            while time.monotonic() < end:
                line = self._link.next_line(_OTHERS_S if replies else end - time.monotonic())
                if line is None:
                    break
                reply = parse(line)
                if reply is not None and reply.message_id == message_id:
                    replies.append(reply)
        return replies

    def _await(self, axis: int, message_id: int, heard: list[str]) -> Reply | None:
        ours = self._device, axis, message_id
        end = time.monotonic() + self._reply_timeout_s
        begun: Reply | None = None
        while (left := end - time.monotonic()) > 0:
            line = self._link.next_line(left)
            if line is None:
                break
            reply = continued(begun, line) if begun is not None else parse(line)
            if reply is not None and (reply.device, reply.axis, reply.message_id) == ours:
                if not reply.goes_on:
                    return reply
                begun = reply
            elif not is_unasked(line):
                heard.append(line)
        return None

    def _wrong_address(self, others: list[int]) -> ProtocolError:
        do = f"device {others[0]} does" if len(others) == 1 else f"devices {', '.join(map(str, others))} do"
        return ProtocolError(
            f"stage: device {self._device} doesn't answer, but {do}; correct stage.device, or give it that address in "
            "Zaber Launcher (renumber)"
        )

    def _no_reply(self, command: str, heard: list[str]) -> RigError:
        fragment = self._link.fragment()
        if fragment:
            heard = [*heard, fragment]
        others = {reply.device for line in heard if (reply := parse(line))} - {self._device}
        if others:
            return self._wrong_address(sorted(others))
        what = repr(command) if command else "the question how it is"
        if heard:
            return ProtocolError(
                f"stage: the answer to {what} was garbled, cut off or somebody else's ({heard[-1][:60]!r}); check "
                "cable, baud rate and stage.kind, then try again"
            )
        return DeviceTimeoutError(
            f"stage: no answer to {what} from {self._link.port}; check power, cable, stage.device and baud rate"
        )

    def _next_id(self) -> int:
        return next(self._message_ids)  # one step of the interpreter: no two threads get the same
