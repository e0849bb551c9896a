"""Append-only record of a session: append, fold, verify.

One JSON object a line, each with its number, the time, and the hash of the line before it, so that a changed or
missing line shows. A record counts once it is on disk (fsync). A torn last line, left by a crash, is dropped when the
journal is opened again; anything else that doesn't fit is damage and refused.

Records: ``started`` (plan hash, devices), ``homed``, ``moved``, ``metered`` (exposure chosen for a depth), ``shot``
(frame on disk: file, sha256, exposure, position), ``event`` (a recovery, a retry, a remark), ``interrupted``,
``failed``, ``resumed``, ``finished``.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from workbench.errors import InputError
from workbench.files import sha256_file


@dataclass(slots=True)
class SessionState:
    """What a journal says when it is read from its first line to its last."""

    records: int = 0
    plan_hash: str = ""
    identities: dict[str, Any] = field(default_factory=dict)
    exposures: dict[str, dict[str, float]] = field(default_factory=dict)
    """Metered exposure by key: ``time_s``, ``iso``, ``peak``."""
    shots: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Recorded shots by id; the newest record of an id counts."""
    events: list[str] = field(default_factory=list)
    finished: bool = False
    status: str = "empty"


def fold(records: list[dict[str, Any]]) -> SessionState:
    """Read records in order into the state they describe."""
    state = SessionState()
    for record in records:
        state.records += 1
        match record["type"]:
            case "started":
                state.plan_hash, state.identities = record["plan_hash"], record["devices"]
                state.status = "running"
            case "resumed":
                state.identities, state.status = record["devices"], "running"
            case "metered":
                state.exposures[record["key"]] = {k: record[k] for k in ("time_s", "iso", "peak")}
            case "shot":
                state.shots[record["shot"]] = record
            case "event":
                state.events.append(record["message"])
            case "interrupted" | "failed":
                state.status = record["type"]
            case "finished":
                state.finished, state.status = True, "finished"
    return state


class Journal:
    """A session's journal, open for appending."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.records, good_bytes = read_journal(path)
        if path.exists() and path.stat().st_size != good_bytes:
            with path.open("r+b") as handle:  # drop the torn last line of a crash before anything is added
                handle.truncate(good_bytes)
                os.fsync(handle.fileno())
        self._last = self.records[-1]["hash"] if self.records else ""
        self._handle = path.open("ab", buffering=0)

    def append(self, record_type: str, /, **values: Any) -> None:
        """Write one record and wait until it is on disk."""
        record: dict[str, Any] = {"n": len(self.records) + 1, "t": round(time.time(), 3), "type": record_type, **values}
        record["prev"] = self._last
        record["hash"] = _hash(record)
        line = json.dumps(record, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode() + b"\n"
        start, count, last = self.path.stat().st_size, len(self.records), self._last
        try:
            while line:  # where not all of it goes, the next write says why
                line = line[self._handle.write(line) :]
            os.fsync(self._handle.fileno())
            self.records.append(record)
            self._last = record["hash"]
        except BaseException as error:
            # A full disk must not leave half a record, nor Ctrl-C one that the next doesn't follow.
            os.truncate(self.path, start)
            del self.records[count:]
            self._last = last
            if isinstance(error, OSError) and error.filename is None:
                error.filename = str(self.path)
            raise

    def state(self) -> SessionState:
        """Fold what has been recorded so far."""
        return fold(self.records)

    def close(self) -> None:
        """Close the file."""
        self._handle.close()


def _hash(record: dict[str, Any]) -> str:
    body = {key: value for key, value in record.items() if key != "hash"}
    return hashlib.sha256(json.dumps(body, sort_keys=True, separators=(",", ":")).encode()).hexdigest()[:16]


def read_journal(path: Path) -> tuple[list[dict[str, Any]], int]:
    """Read and check a journal; also the number of bytes that hold whole records.

    Raises
    ------
    InputError
        A record in the middle is damaged, missing or changed.
    """
    if not path.exists():
        return [], 0
    data = path.read_bytes()
    records: list[dict[str, Any]] = []
    position, previous = 0, ""
    while position < len(data):
        end = data.find(b"\n", position)
        line = data[position : end if end >= 0 else len(data)]
        try:
            record = json.loads(line)
            sound = record["prev"] == previous and record["hash"] == _hash(record) and record["n"] == len(records) + 1
        except (ValueError, KeyError, TypeError):
            record, sound = None, False
        if end < 0 or (not sound and end == len(data) - 1 and record is None):
            return records, position  # torn last line
        if not sound:
            raise InputError(
                f"{path}: record {len(records) + 1} is damaged or was changed; the session can't be trusted, "
                "start a new one with `workbench calibrate`"
            )
        records.append(record)
        previous, position = record["hash"], end + 1
    return records, position


def verified_shots(state: SessionState, session_dir: Path) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Recorded shots whose frames are on disk as recorded; and the ids of those that are not."""
    good: dict[str, dict[str, Any]] = {}
    bad: list[str] = []
    for shot_id, record in state.shots.items():
        path = session_dir / record["file"]
        if path.is_file() and path.stat().st_size == record["bytes"] and sha256_file(path) == record["sha256"]:
            good[shot_id] = record
        else:
            bad.append(shot_id)
    return good, bad
