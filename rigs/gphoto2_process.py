"""The camera's process seen from outside: every call has a deadline; one that misses it is killed with the process.

libgphoto2 can block for minutes and can't be interrupted. Here nothing waits longer than it was told to, Ctrl-C
works at any moment, and :meth:`WorkerProcess.kill` ends a hung call from any thread.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from rigs.gphoto2_faults import Fault, FaultError, classify
from rigs.gphoto2_wire import Message, Unpacker, pack

WORKER_COMMAND: tuple[str, ...] = (sys.executable, "-P", "-m", "rigs.gphoto2_worker")

_LAST_WORDS_BYTES = 2000
_FAREWELL_S = 2.0
_BROKEN_OFF_S = 1.0
"""Patience at closing with a process whose last call was broken off by Ctrl-C: it may hang for minutes."""


class WorkerProcess:
    """Starts the camera's process when it is needed; one call at a time.

    Parameters
    ----------
    environment
        Added to the environment of the process.
    command
        What is run; it speaks :mod:`rigs.gphoto2_wire` on its standard input and output.
    """

    def __init__(self, environment: Mapping[str, str], command: Sequence[str] = WORKER_COMMAND) -> None:
        package_root = str(Path(__file__).resolve().parent.parent)
        paths = [package_root, *filter(None, [os.environ.get("PYTHONPATH")])]
        self._environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), **environment}
        self._command = tuple(command)
        self._process: subprocess.Popen[bytes] | None = None
        self._unpacker = Unpacker()
        self._stderr: IO[bytes] | None = None
        self._next_id = self._answered_id = 0
        self.starts = 0
        """How many processes were started so far."""

    @property
    def pid(self) -> int | None:
        """Process id, None where none runs."""
        return self._process.pid if self._process is not None else None

    def call(self, op: str, deadline_s: float, /, **arguments: Any) -> Any:
        """Have one operation done.

        Parameters
        ----------
        op, arguments
            The operation and its arguments (see :class:`rigs.gphoto2_worker.Library`).
        deadline_s
            The process is killed when the answer takes longer.

        Raises
        ------
        FaultError
            The operation failed, hung, or took the process down.
        OSError
            A file couldn't be written on our side.
        """
        process = self._running()
        self._next_id += 1
        number = self._next_id
        try:
            assert process.stdin is not None
            process.stdin.write(pack({"id": number, "op": op, **arguments}))
        except (BrokenPipeError, ValueError):
            raise self._dead(op) from None
        reply = self._reply(process, op, number, time.monotonic() + deadline_s)
        self._answered_id = number
        if "os_error" in reply:
            error = reply["os_error"]
            raise OSError(error["errno"], error["text"], arguments.get("path"))
        if "error" in reply:
            error = reply["error"]
            raise classify(op, int(error["code"]), str(error["text"]), error.get("log", ()))
        return reply.get("ok")

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            self._unpacker = Unpacker()
            self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._stderr,
                env=self._environment,
                start_new_session=True,  # a terminal's Ctrl-C reaches us, not it
                bufsize=0,
            )
            self.starts += 1
        return self._process

    def _reply(self, process: subprocess.Popen[bytes], op: str, number: int, deadline: float) -> Message:
        assert process.stdout is not None
        while True:
            remaining = deadline - time.monotonic()
            if remaining <= 0:
                self.kill()
                raise FaultError(Fault.HUNG, op, "no answer in time")
            try:
                readable, _, _ = select.select([process.stdout], [], [], remaining)
                if not readable:
                    continue
                data = os.read(process.stdout.fileno(), 1 << 20)
            except (OSError, ValueError):  # closed by kill() in another thread
                raise self._dead(op) from None
            if not data:
                raise self._dead(op)
            try:
                messages = self._unpacker.feed(data)
            except ValueError as error:
                self.kill()
                raise FaultError(Fault.CRASHED, op, f"unreadable answer: {error}") from error
            for message in messages:
                if message.get("id") == number:  # an older one answers a call that was interrupted
                    return message

    def _dead(self, op: str) -> FaultError:
        process, stderr = self._process, self._stderr
        code = None
        if process is not None:
            with suppress(subprocess.TimeoutExpired):
                code = process.wait(_FAREWELL_S)
        words = ""
        if stderr is not None and not stderr.closed:
            stderr.seek(0, os.SEEK_END)
            stderr.seek(max(0, stderr.tell() - _LAST_WORDS_BYTES))
            lines = stderr.read().decode(errors="replace").strip().splitlines()
            words = lines[-1].strip() if lines else ""
        self.kill()
        if code is not None and code < 0:
            with suppress(ValueError):
                words = " ".join(filter(None, [f"killed by {signal.Signals(-code).name}", words]))
        return FaultError(Fault.CRASHED, op, words or "the camera process ended")

    def kill(self) -> None:
        """End the process at once, from any thread; the next call starts a new one."""
        process, self._process = self._process, None
        if process is None:
            return
        self._answered_id = self._next_id
        with suppress(ProcessLookupError):
            process.kill()
        with suppress(subprocess.TimeoutExpired):  # stuck in the kernel: it ends when its USB transfer does
            process.wait(_FAREWELL_S)
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()
        stderr, self._stderr = self._stderr, None
        if stderr is not None:
            stderr.close()

    def close(self, deadline_s: float) -> None:
        """Let the camera go politely, within the deadline; then the process ends."""
        if self._process is not None:
            broken_off = self._answered_id != self._next_id
            try:
                self.call("close", min(deadline_s, _BROKEN_OFF_S) if broken_off else deadline_s)
            except (FaultError, OSError):
                pass
            finally:  # a second Ctrl-C, too, must leave nothing behind that holds the camera
                self.kill()
