"""A serial port offered over the network as RFC 2217, by pyserial's own server side."""

from __future__ import annotations

import select
import socket
import threading

import serial
import serial.rfc2217


class _PtyPort(serial.Serial):
    """A pseudo-terminal has no modem lines; a real port's would be switched and asked for."""

    cts = dsr = ri = cd = False

    def _update_dtr_state(self) -> None: ...
    def _update_rts_state(self) -> None: ...


class _Out:
    """Where pyserial's port manager writes its own part of the conversation."""

    def __init__(self, client: socket.socket) -> None:
        self._client, self._lock = client, threading.Lock()

    def write(self, data: bytes) -> None:
        with self._lock:
            self._client.sendall(data)


class Rfc2217Server:
    """Serves the serial port ``path`` to one client."""

    def __init__(self, path: str) -> None:
        self._serial = _PtyPort(path, timeout=0.01)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"rfc2217://127.0.0.1:{self._listener.getsockname()[1]}"
        self._running = True
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> Rfc2217Server:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._running = False
        self._thread.join()
        self._listener.close()
        self._serial.close()

    def _serve(self) -> None:
        while self._running:
            if select.select([self._listener], [], [], 0.05)[0]:
                client, _ = self._listener.accept()
                with client:
                    self._bridge(client)

    def _bridge(self, client: socket.socket) -> None:
        out = _Out(client)
        manager = serial.rfc2217.PortManager(self._serial, out)
        while self._running:
            readable = select.select([client, self._serial.fileno()], [], [], 0.05)[0]
            try:
                if self._serial.fileno() in readable:
                    out.write(b"".join(manager.escape(self._serial.read(self._serial.in_waiting))))
                if client in readable:
                    data = client.recv(4096)
                    if not data:
                        return
                    self._serial.write(b"".join(manager.filter(data)))
            except OSError:
                return
