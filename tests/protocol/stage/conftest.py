"""Stages to test: stand-ins always, and real ones where the environment names them."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace

import pytest

from rigs.errors import RigError
from rigs.grbl_stage import GrblSettings, GrblStage
from tests.standins.grbl_firmware import GrblFirmware
from tests.standins.pty_server import PtyServer
from tests.standins.rail import Rail
from tests.standins.rfc2217_server import Rfc2217Server
from tests.standins.tcp_server import TcpServer

FAST = {110: 3000000.0, 120: 1000000.0, 24: 60000.0, 25: 600000.0, 26: 2}
"""50 m/s: a rail on which moves take milliseconds."""


@dataclass
class GrblBench:
    """A stand-in on a pseudo-terminal, and drivers opened on it."""

    firmware: GrblFirmware
    line: PtyServer
    stages: list[GrblStage] = field(default_factory=list)

    def open(self, **changes: object) -> GrblStage:
        settings = GrblSettings(port=self.line.path, reply_timeout_s=1.0, boot_timeout_s=6.0)
        stage = GrblStage(replace(settings, **changes))  # type: ignore[arg-type]
        self.stages.append(stage)
        return stage

    def homed(self, **changes: object) -> GrblStage:
        stage = self.open(**changes)
        stage.home()
        return stage

    def slow(self, mm_min: float = 6000.0, acceleration: float = 1000.0) -> None:
        """Slow enough to interfere."""
        self.firmware.settings |= {110: mm_min, 120: acceleration}

    def forget_sent(self) -> None:
        with self.line.lock:
            self.line.sent.clear()

    def wait_until(self, what: Callable[[], bool], limit_s: float = 5.0) -> None:
        end = time.monotonic() + limit_s
        while not what():
            assert time.monotonic() < end, "it never came to that"
            time.sleep(0.002)


@pytest.fixture
def grbl() -> Iterator[GrblBench]:
    firmware = GrblFirmware(Rail(carriage_mm=60.0), FAST)
    with PtyServer(firmware) as line:
        bench = GrblBench(firmware, line)
        try:
            yield bench
        finally:
            for stage in bench.stages:
                with suppress(RigError):
                    stage.close()


class Mover(threading.Thread):
    """Calls something on another thread and keeps what it raised."""

    def __init__(self, call: Callable[[], object]) -> None:
        super().__init__(daemon=True)
        self._call = call
        self.error: BaseException | None = None
        self.start()

    def run(self) -> None:
        try:
            self._call()
        except BaseException as error:
            self.error = error

    def ended(self, limit_s: float = 10.0) -> BaseException | None:
        self.join(limit_s)
        assert not self.is_alive()
        return self.error


@pytest.fixture
def in_background() -> Callable[[Callable[[], object]], Mover]:
    return Mover


_BENCH = [pytest.param(os.environ["WORKBENCH_TEST_GRBL"], marks=pytest.mark.hardware, id="bench")]\
    if "WORKBENCH_TEST_GRBL" in os.environ else []  # fmt: skip


@pytest.fixture(params=["pty", "socket", "rfc2217", *_BENCH])
def any_grbl(request: pytest.FixtureRequest) -> Iterator[GrblStage]:
    """A GRBL stage, homed: the stand-in over each kind of line, and the one of WORKBENCH_TEST_GRBL where it is set."""
    with ExitStack() as held:
        port = request.param
        if port in ("pty", "socket", "rfc2217"):
            firmware = GrblFirmware(Rail(carriage_mm=60.0), FAST | {110: 60000.0, 120: 5000.0})
            line = held.enter_context(TcpServer(firmware) if port == "socket" else PtyServer(firmware))
            if port == "rfc2217":
                assert isinstance(line, PtyServer)
                line = held.enter_context(Rfc2217Server(line.path))
            port = line.path if isinstance(line, PtyServer) else line.url
        stage = GrblStage(GrblSettings(port=port))
        held.callback(stage.close)
        stage.home()
        yield stage
