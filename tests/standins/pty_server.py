"""A pseudo-terminal that behaves as a serial port with a device behind it, and fails as cables do."""

from __future__ import annotations

import os
import select
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator
from typing import Protocol


class Device(Protocol):
    """Bytes in, bytes out, in its own time."""

    output: bytearray

    def receive(self, data: bytes) -> None: ...
    def step(self, now: float) -> None: ...


class PtyServer:
    """Runs a device on a pseudo-terminal; :attr:`path` is what a driver opens.

    With ``on_open`` it notices that a driver opens the port, as boards do that are reset by DTR.
    """

    def __init__(self, device: Device, *, on_open: Callable[[], None] | None = None, tick_s: float = 0.001) -> None:
        self.device = device
        self.lock = threading.RLock()
        self.sent: bytearray = bytearray()
        """What the driver has sent so far."""
        self.silent = False
        self.late_s = 0.0
        """How long each way takes: an answer comes twice as late."""
        self.corrupt: Callable[[bytes], bytes] = bytes
        """Changes what the device says on its way."""
        self.corrupt_input: Callable[[bytes], bytes] = bytes
        self._on_open, self._tick_s = on_open, tick_s
        self._to_device: deque[tuple[float, bytes]] = deque()
        self._to_driver: deque[tuple[float, bytes]] = deque()
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        os.close(slave)
        self._open = self._running = False
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> PtyServer:
        self._running = True
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._running = False
        self._thread.join()
        self.unplug()

    def unplug(self) -> None:
        """The cable is pulled: the far end sees what it sees of a USB serial adapter that vanishes."""
        with self.lock:
            if self._master >= 0:
                os.close(self._master)
                self._master = -1

    def say(self, data: bytes) -> None:
        """Bytes from nowhere: noise, or a device that speaks unasked."""
        with self.lock:
            self._write(data)

    def _serve(self) -> None:
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        while self._running:
            events = dict(poll.poll(self._tick_s * 1000))
            with self.lock:
                if self._master < 0:
                    return
                self._exchange(events.get(self._master, 0))
            if events.get(self._master, 0) & select.POLLHUP:
                time.sleep(self._tick_s)

    def _exchange(self, event: int) -> None:
        connected = not event & select.POLLHUP
        if connected and not self._open and self._on_open is not None:
            self._on_open()
        self._open = connected
        if connected and event & select.POLLIN:
            data = os.read(self._master, 4096)
            self.sent += data
            self._to_device.append((time.monotonic() + self.late_s, data))
        for data in _arrived(self._to_device):
            self.device.receive(self.corrupt_input(data))
        self.device.step(time.monotonic())
        output = bytes(self.device.output)
        self.device.output.clear()
        if connected and output and not self.silent:
            self._to_driver.append((time.monotonic() + self.late_s, self.corrupt(output)))
        for data in _arrived(self._to_driver):
            self._write(data)

    def _write(self, data: bytes) -> None:
        if self._master >= 0 and data:
            os.write(self._master, data)


def _arrived(way: deque[tuple[float, bytes]]) -> Iterator[bytes]:
    while way and way[0][0] <= time.monotonic():
        yield way.popleft()[1]
