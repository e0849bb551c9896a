"""How the camera's own process and ours talk: JSON messages, each preceded by its length, over two pipes."""

from __future__ import annotations

import json
import struct
from typing import Any

Message = dict[str, Any]

_HEADER = struct.Struct(">I")
LONGEST = 64 << 20
"""No honest message is longer (a preview is about 1 MB): anything else is a torn or foreign stream."""


def pack(message: Message) -> bytes:
    """One message as bytes: 4 bytes length, big-endian, then JSON in UTF-8."""
    body = json.dumps(message, ensure_ascii=False, separators=(",", ":")).encode("utf-8", "replace")
    return _HEADER.pack(len(body)) + body


class Unpacker:
    """Puts messages together from whatever pieces a pipe delivers."""

    def __init__(self) -> None:
        self._pending = bytearray()

    def feed(self, data: bytes) -> list[Message]:
        """Take bytes; return the messages that are complete now.

        Raises
        ------
        ValueError
            The bytes are no messages.
        """
        self._pending += data
        messages: list[Message] = []
        while len(self._pending) >= _HEADER.size:
            (length,) = _HEADER.unpack_from(self._pending)
            if length > LONGEST:
                raise ValueError(f"a message of {length} bytes")
            end = _HEADER.size + length
            if len(self._pending) < end:
                break
            message = json.loads(self._pending[_HEADER.size : end])
            if not isinstance(message, dict):
                raise ValueError("a message that is no object")
            del self._pending[:end]
            messages.append(message)
        return messages
