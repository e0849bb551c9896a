"""Versions of banks: an append-only file whose state follows from reading it.

One JSON object a line: ``register`` gives a bank the next version, ``certify``, ``activate`` and ``revoke`` say what
became of it. Nothing is ever rewritten; rolling back is activating an older version. A torn last line (power cut) is
ignored, and closed by the next write.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from calibration.errors import BankError

Act = Literal["register", "certify", "activate", "revoke"]
_ID = re.compile(r"^[0-9a-z]+$")
_VERSION = re.compile(r"^v(\d+)$", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Entry:
    """State of one bank."""

    id: str
    version: int
    certified: bool = False
    certificate: str = ""
    """What the bank was certified for, and until when."""
    revoked: bool = False
    revoked_reason: str = ""
    active: bool = False

    @property
    def state(self) -> str:
        """One word for a table: revoked, active, certified or registered."""
        if self.revoked:
            return "revoked"
        return "active" if self.active else ("certified" if self.certified else "registered")


@dataclass(frozen=True, slots=True)
class Registry:
    """Banks of one ``banks`` directory, by ascending version."""

    path: Path
    entries: tuple[Entry, ...]

    @property
    def active(self) -> Entry | None:
        """The active bank, if there is one."""
        return next((entry for entry in self.entries if entry.active), None)

    def resolve(self, reference: str) -> Entry:
        """Find a bank by id, unique beginning of an id (at least 4 digits), version like ``v3``, or ``active``.

        Raises
        ------
        BankError
            Nothing or more than one bank fits.
        """
        reference = reference.strip()
        if reference == "active":
            if self.active is None:
                hint = "activate one" if self.entries else "make one with calibrate"
                raise BankError(f"{self.path.parent}: no bank is active; {hint}")
            return self.active
        version = _VERSION.match(reference)
        if version:
            found = [e for e in self.entries if e.version == int(version[1])]
        else:
            lower = reference.lower()
            found = [e for e in self.entries if e.id == lower]
            if not found and len(lower) >= 4:
                found = [e for e in self.entries if e.id.startswith(lower)]
        if len(found) == 1:
            return found[0]
        if found:
            raise BankError(f"bank {reference!r} is ambiguous ({', '.join(e.id for e in found)}); give more digits")
        known = ", ".join(f"v{e.version} {e.id}" for e in self.entries[-5:]) or "none"
        raise BankError(f"{self.path.parent}: no bank {reference!r}; known: {known}")


def read_registry(banks_dir: str | Path) -> Registry:
    """Fold the registry of a directory; an absent file is an empty registry.

    Raises
    ------
    BankError
        A line other than the last is damaged, or the file can't be read.
    """
    path = Path(banks_dir) / "registry.jsonl"
    entries: dict[str, Entry] = {}
    for record in _records(path):
        _apply(entries, record)
    return Registry(path, tuple(sorted(entries.values(), key=lambda e: e.version)))


def next_version(banks_dir: str | Path, bank_id: str) -> int:
    """Version that a bank has, or will have once it is registered."""
    entries = read_registry(banks_dir).entries
    known = next((e.version for e in entries if e.id == bank_id), None)
    return known or 1 + max((e.version for e in entries), default=0)


def register(banks_dir: str | Path, bank_id: str, *, active: bool = False) -> Entry:
    """Give a bank the next version; one that is registered already keeps its own.

    With ``active`` it becomes the active one in the same write: both or neither.

    Raises
    ------
    BankError
        Can't be written; or ``active`` and the bank is a revoked one.
    """
    registry = read_registry(banks_dir)
    known = next((e for e in registry.entries if e.id == bank_id), None)
    records: list[dict[str, Any]] = []
    if known is None:
        records.append({"act": "register", "id": bank_id, "version": next_version(banks_dir, bank_id)})
    if active:
        _refuse_revoked(known)
        records.append({"act": "activate", "id": bank_id})
    if records:
        _append(registry.path, *records)
    return read_registry(banks_dir).resolve(bank_id)


def certify(banks_dir: str | Path, reference: str, note: str) -> Entry:
    """Certify a bank; ``note`` says for what and how long it holds.

    Raises
    ------
    BankError
        Unknown bank, or a revoked one.
    """
    return _act(banks_dir, reference, "certify", {"note": note}, allow_revoked=False)


def activate(banks_dir: str | Path, reference: str) -> Entry:
    """Make a bank the one that ``active`` means; the previous one stays as it is. Older versions too: a roll-back.

    Raises
    ------
    BankError
        Unknown bank, or a revoked one.
    """
    return _act(banks_dir, reference, "activate", {}, allow_revoked=False)


def revoke(banks_dir: str | Path, reference: str, reason: str) -> Entry:
    """Withdraw a bank for good: it is no longer active and can't be activated again; its files stay."""
    return _act(banks_dir, reference, "revoke", {"reason": reason}, allow_revoked=True)


def _act(banks_dir: str | Path, reference: str, act: Act, more: Mapping[str, Any], *, allow_revoked: bool) -> Entry:
    registry = read_registry(banks_dir)
    entry = registry.resolve(reference)
    if not allow_revoked:
        _refuse_revoked(entry)
    _append(registry.path, {"act": act, "id": entry.id, **more})
    return read_registry(banks_dir).resolve(entry.id)


def _refuse_revoked(entry: Entry | None) -> None:
    if entry is not None and entry.revoked:
        why = f" ({entry.revoked_reason})" if entry.revoked_reason else ""
        raise BankError(f"bank v{entry.version} {entry.id} is revoked{why}; choose another")


def _apply(entries: dict[str, Entry], record: Mapping[str, Any]) -> None:
    act, bank_id = record["act"], record["id"]
    if not _ID.match(bank_id):
        raise ValueError(bank_id)  # an id is also the name of a directory
    if act == "register":
        entries.setdefault(bank_id, Entry(id=bank_id, version=int(record["version"])))
        return
    entry = entries[bank_id]
    if act == "certify":
        entries[bank_id] = replace(entry, certified=True, certificate=str(record.get("note", "")))
    elif act == "activate":
        for other in list(entries.values()):
            if other.active:
                entries[other.id] = replace(other, active=False)
        entries[bank_id] = replace(entries[bank_id], active=True)
    elif act == "revoke":
        entries[bank_id] = replace(entry, revoked=True, active=False, revoked_reason=str(record.get("reason", "")))
    else:
        raise KeyError(act)


def _records(path: Path) -> list[Mapping[str, Any]]:
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise BankError(f"{path}: can't be read ({error.strerror or error})") from error
    lines = content.split(b"\n")
    known: dict[str, Entry] = {}
    records = []
    for number, line in enumerate(lines, start=1):
        # without its newline a line was torn by a power cut: the act was never confirmed to anyone
        if not line.strip() or number == len(lines) or line.endswith(_TORN):
            continue
        try:
            record = json.loads(line)
            _apply(known, record)
        except (ValueError, KeyError, TypeError):
            raise BankError(f"{path}, line {number}: is damaged; restore the registry from a copy") from None
        records.append(record)
    return records


_TORN = b" (torn)"


def _append(path: Path, *records: Mapping[str, Any]) -> None:
    now = datetime.now(UTC).isoformat(timespec="seconds")
    text = "".join(json.dumps({**record, "at": now}, sort_keys=True) + "\n" for record in records)
    size = path.stat().st_size if path.exists() else None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab+") as stream:
            if stream.tell() > 0:
                stream.seek(-1, os.SEEK_END)
                if stream.read(1) != b"\n":
                    text = _TORN.decode() + "\n" + text  # mark the torn line as such, so that it stays ignored
            stream.write(text.encode())
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as error:
        with suppress(OSError):  # a full disk must not leave half a record
            if size is None:
                path.unlink(missing_ok=True)
            else:
                os.truncate(path, size)
        raise BankError(
            f"{path}: can't be written ({error.strerror or error}); free some space or raise the limit, and try again"
        ) from error
