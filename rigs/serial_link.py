"""A serial line as lines of text with deadlines; the only place that knows pyserial.

One thread reads, so that an unplugged cable is noticed at once and anybody may write at any moment: a stop doesn't
queue behind a command that waits for its answer. Whatever pyserial or the operating system raises becomes a
:class:`rigs.errors.RigError` here and nowhere else.

Traffic is logged byte by byte, with seconds since the port was opened, under ``rigs.serial_link`` (level DEBUG).
"""

from __future__ import annotations

import errno
import logging
import re
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import serial
from serial.tools import list_ports

from rigs.errors import (
    ConfigError,
    ConnectionLostError,
    DeviceBusyError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    RigError,
)

_log = logging.getLogger(__name__)

_READ_SLICE_S = 0.05
_WRITE_TIMEOUT_S = 3.0
_LONGEST_LINE = 1024
"""More bytes than this without a line end are noise (a wrong baud rate, mostly)."""

_HOST_AND_PORT = re.compile(r"://[^/:]+:\d+")
_USB_ID = re.compile(r"usb:([0-9a-fA-F]{4}):([0-9a-fA-F]{4})(?::(.+))?")


def find_port(port: str) -> str:
    """Resolve ``usb:VID:PID`` or ``usb:VID:PID:SERIAL`` to a device path; paths and URLs pass unchanged.

    Raises
    ------
    ConfigError
        No port is given, or it is no USB id.
    DeviceNotFoundError
        No such device is plugged in, or several are.
    """
    if not port:
        raise ConfigError(f"stage.port is missing: give a path, usb:VID:PID or a URL; {_ports_found()}")
    if not port.startswith("usb:"):
        return port
    match = _USB_ID.fullmatch(port)
    if match is None:
        raise ConfigError(f"stage.port: {port!r} is no USB id; write usb:2341:0043, or usb:2341:0043:SERIAL")
    vendor, product, serial_number = int(match[1], 16), int(match[2], 16), match[3]
    found = [
        info
        for info in list_ports.comports()
        if (info.vid, info.pid) == (vendor, product) and serial_number in (None, info.serial_number)
    ]
    if not found:
        raise DeviceNotFoundError(
            f"stage: {port} is not plugged in; plug it in, or correct stage.port; {_ports_found()}"
        )
    if len(found) > 1:
        numbers = ", ".join(f"{port}:{info.serial_number}" for info in found)
        raise DeviceNotFoundError(f"stage: {port} fits {len(found)} devices; name one by its serial number: {numbers}")
    return str(found[0].device)


@dataclass(frozen=True, slots=True)
class FoundPort:
    """A serial port that is plugged in, not opened."""

    device: str
    usb_id: str = ""
    """As rig.yaml takes it (``usb:1a86:7523``); empty where it is on no USB."""
    description: str = ""

    def __str__(self) -> str:
        return f"{self.device} ({self.usb_id})" if self.usb_id else self.device


def discover_ports() -> tuple[FoundPort, ...]:
    """Every serial port that the operating system lists, without opening one."""
    return tuple(
        FoundPort(
            str(info.device),
            f"usb:{info.vid:04x}:{info.pid:04x}" if info.vid is not None else "",
            info.description if info.description not in (None, "n/a") else "",
        )
        for info in sorted(list_ports.comports(), key=lambda info: str(info.device))
    )


def _ports_found() -> str:
    return f"serial ports found: {', '.join(map(str, discover_ports())) or 'none'}"


def _open(port: str, baud_rate: int) -> serial.Serial:
    path = find_port(port)
    try:
        line = serial.serial_for_url(path, do_not_open=True, baudrate=baud_rate, timeout=_READ_SLICE_S)
        if not path.startswith("rfc2217://"):  # it has none, and says so by an exception
            line.write_timeout = _WRITE_TIMEOUT_S
        if "://" not in path:
            line.exclusive = True
        line.open()
    except (OSError, ValueError, TypeError) as error:  # SerialException is an OSError; TypeError: a URL without a port
        raise _cannot_open(port, path, error) from error
    return line


def _cannot_open(port: str, path: str, error: Exception) -> RigError:
    """What an exception at opening means, with the way out."""
    text, number = str(error), getattr(error, "errno", None)
    if isinstance(error, ValueError):
        return ConfigError(f"stage.port: {port!r} can't be opened: {text}")
    if "://" in path:
        return _cannot_connect(path, text)
    if number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return DeviceBusyError(f"stage: {path} is used by another program; close it and try again")
    if number in (errno.EACCES, errno.EPERM):
        return DeviceNotFoundError(
            f"stage: no permission for {path}; add yourself to its group (mostly dialout) and log in again"
        )
    if number == errno.ENOENT:
        return DeviceNotFoundError(
            f"stage: {path} can't be opened (it isn't there); check plug, power and stage.port; {_ports_found()}"
        )
    if number == errno.EISDIR or "Could not configure port" in text:
        return DeviceNotFoundError(f"stage: {path} is no serial port; correct stage.port; {_ports_found()}")
    return DeviceNotFoundError(
        f"stage: {path} can't be opened ({text}); check plug, power and stage.port; {_ports_found()}"
    )


def _cannot_connect(url: str, text: str) -> RigError:
    if not _HOST_AND_PORT.search(url):
        return ConfigError(f"stage.port: {url!r} names no host and port; write {url.split(':')[0]}://192.168.1.5:23")
    if "RFC2217" in text:
        return DeviceNotFoundError(
            f"stage: what answers at {url} doesn't speak RFC 2217; correct stage.port, or try socket:// instead"
        )
    why = text.removeprefix(f"Could not open port {url}: ")
    return DeviceNotFoundError(
        f"stage: {url} can't be reached ({why}); check the network, the power there, and host and port in stage.port"
    )


class SerialLink:
    """An open serial line.

    Parameters
    ----------
    port
        Device path, ``usb:VID:PID[:SERIAL]``, or a pyserial URL (``socket://host:port``, ``rfc2217://host:port``).
    baud_rate
        Bits per second; meaningless for ``socket://``.

    Raises
    ------
    ConfigError
        The port is no port.
    DeviceNotFoundError
        There is no such device, or no permission.
    DeviceBusyError
        Another program holds it.
    """

    def __init__(self, port: str, baud_rate: int) -> None:
        self.port = port
        self._line = _open(port, baud_rate)
        self._opened_s = time.monotonic()
        self._writing = threading.Lock()
        self._arrived = threading.Condition()
        self._lines: deque[str] = deque()
        self._fragment = b""
        self._loss: str | None = None
        self._closing = False
        self._reader = threading.Thread(target=self._read, name=f"serial {port}", daemon=True)
        self._reader.start()

    def write(self, data: bytes, *, unless: Callable[[], bool] = lambda: False) -> bool:
        """Send bytes now, whoever else waits for answers.

        Parameters
        ----------
        data
            What to send.
        unless
            Asked when nobody else writes: True withholds the bytes. A stop that came just before is never overtaken.

        Returns
        -------
        bool
            Whether the bytes were sent.

        Raises
        ------
        ConnectionLostError
            The line is gone.
        DeviceTimeoutError
            The line takes no more bytes.
        """
        with self._writing:
            if unless():
                return False
            if self._closing:
                raise ConnectionLostError(f"stage: {self.port} is closed")
            if self._loss is not None:
                raise self._lost(self._loss)
            self._log_traffic(">", data)
            try:
                self._line.write(data)
            except serial.SerialTimeoutException as error:
                raise DeviceTimeoutError(f"stage: {self.port} takes no bytes; check its cable and power") from error
            except OSError as error:
                self._lose(str(error))
                raise self._lost(str(error)) from error
        return True

    def next_line(self, timeout_s: float) -> str | None:
        """Take the oldest line that has arrived, without its end; None where none comes in time.

        Bytes outside ASCII are shown as ``\\xNN``.

        Raises
        ------
        ConnectionLostError
            The line is gone, and what had arrived before is used up.
        """
        deadline = time.monotonic() + timeout_s
        with self._arrived:
            while not self._lines:
                if self._loss is not None:
                    raise self._lost(self._loss)
                left = deadline - time.monotonic()
                if left <= 0:
                    return None
                self._arrived.wait(left)
            return self._lines.popleft()

    def fragment(self) -> str:
        """Return the beginning of a line whose end hasn't arrived."""
        with self._arrived:
            return _text(self._fragment)

    def close(self) -> None:
        """Close the line; safe to call twice."""
        self._closing = True
        if threading.current_thread() is not self._reader:
            self._reader.join()
        with self._writing, suppress(OSError):
            self._line.close()

    def _read(self) -> None:
        while not self._closing:
            try:
                data = self._line.read(1)
                if data:
                    data += self._line.read(self._line.in_waiting)
            except (OSError, TypeError, AttributeError) as error:  # the last two: pyserial, closed under its feet
                self._lose(str(error))
                return
            if data:
                self._log_traffic("<", data)
                self._take(data)

    def _take(self, data: bytes) -> None:
        with self._arrived:
            *lines, self._fragment = (self._fragment + data).split(b"\n")
            self._lines.extend(_text(line) for line in lines if line.strip())
            if len(self._fragment) > _LONGEST_LINE:
                self._lines.append(_text(self._fragment))
                self._fragment = b""
            self._arrived.notify_all()

    def _log_traffic(self, direction: str, data: bytes) -> None:
        _log.debug("%s %9.3f s %s %r", self.port, time.monotonic() - self._opened_s, direction, data)

    def _lose(self, why: str) -> None:
        with self._arrived:
            self._loss = self._loss or why
            self._arrived.notify_all()

    def _lost(self, why: str) -> ConnectionLostError:
        if "returned no data" in why:  # pyserial's words are about its own reading
            why = "nothing comes from it any more: unplugged, switched off, or read by another program too"
        return ConnectionLostError(
            f"stage: connection to {self.port} is lost ({why}); plug it in, start again, and home the stage"
        )


def _text(line: bytes) -> str:
    return line.strip(b"\r\n\0 ").decode("ascii", "backslashreplace")
