"""Writing that never leaves half a file: temporary name, sync, rename."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any


def sync_directory(directory: Path) -> None:
    """Make renames in ``directory`` durable."""
    with suppress(OSError):  # some file systems refuse to open or sync a directory
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def made_directory(directory: Path) -> Iterator[None]:
    """Make a directory and its parents; when the block fails, remove those that it made, with all in them."""
    missing = next((path for path in (*reversed(directory.parents), directory) if not path.exists()), None)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException as error:
        if missing is not None:
            shutil.rmtree(missing, ignore_errors=True)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(directory)  # writing to an open file tells no name
        raise


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside ``path``; rename it into place when the block ends well, remove it otherwise."""
    with made_directory(path.parent):
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
        os.close(descriptor)
        temporary = Path(name)
        try:
            yield temporary
            with temporary.open("rb") as handle:
                os.fsync(handle.fileno())
            temporary.chmod(0o644)
            temporary.replace(path)
            sync_directory(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a whole file or nothing."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write a whole UTF-8 file or nothing."""
    write_bytes(path, text.encode())


def json_ready(value: Any) -> Any:
    """Replace what JSON can't hold: NaN and infinity by null, arrays and tuples by lists, paths by text."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): json_ready(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_ready(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON, whole or nothing."""
    write_text(path, json.dumps(json_ready(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n")


@contextmanager
def staged_files(directory: Path) -> Iterator[Path]:
    """Give an empty temporary directory; when the block ends well, move its files and folders into ``directory``.

    They are made elsewhere and renamed one by one, so that none is ever half written; other files in
    ``directory`` stay. When the block fails nothing is left behind.
    """
    with made_directory(directory):
        temporary = Path(tempfile.mkdtemp(dir=directory, prefix=".making."))
        try:
            yield temporary
            for path in sorted(temporary.rglob("*")):
                if path.is_file():
                    with path.open("rb") as handle:
                        os.fsync(handle.fileno())
            for path in sorted(temporary.iterdir()):
                path.replace(directory / path.name)
            sync_directory(directory)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def sha256_file(path: Path) -> str:
    """Hex SHA-256 of a file's bytes."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def sha256_json(value: Any) -> str:
    """Hex SHA-256 of canonical JSON (sorted keys, no spaces)."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
