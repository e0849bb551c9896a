"""A device on a loopback TCP port, as a terminal server offers it."""

from __future__ import annotations

import select
import socket
import threading
import time

from tests.standins.pty_server import Device


class TcpServer:
    """Serves one client at a time."""

    def __init__(self, device: Device, *, tick_s: float = 0.001) -> None:
        self.device, self._tick_s = device, tick_s
        self.sent = bytearray()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.url = f"socket://127.0.0.1:{self.port}"
        self._client: socket.socket | None = None
        self._running = True
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> TcpServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._running = False
        self._thread.join()
        self._listener.close()
        self._drop()

    def hang_up(self) -> None:
        """The network goes away."""
        client, self._client = self._client, None
        if client is not None:
            client.shutdown(socket.SHUT_RDWR)
            client.close()

    def _drop(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def _serve(self) -> None:
        while self._running:
            client = self._client
            ready, _, _ = select.select([self._listener, *([client] if client else [])], [], [], self._tick_s)
            if self._listener in ready:
                self._drop()
                self._client, _ = self._listener.accept()
            try:
                self._exchange(client if client in ready else None)
            except OSError:
                self._drop()

    def _exchange(self, readable: socket.socket | None) -> None:
        if readable is not None:
            data = readable.recv(4096)
            if not data:
                self._drop()
            self.sent += data
            self.device.receive(data)
        self.device.step(time.monotonic())
        output = bytes(self.device.output)
        self.device.output.clear()
        if self._client is not None and output:
            self._client.sendall(output)
