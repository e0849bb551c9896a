"""What a check found: how bad it is, what was seen, and the way to mend it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

SUBJECTS = ("project", "computer", "camera", "stage", "panel")
"""What is checked, in the order of the report."""


class Severity(IntEnum):
    """How bad it is."""

    OK = 0
    NOTE = 1
    """Good to know; nothing has to be done."""
    WARNING = 2
    """May spoil a calibration, or a part of the product doesn't work."""
    ERROR = 3
    """Would stop a calibration."""

    @property
    def word(self) -> str:
        """As it stands in reports."""
        return self.name.lower()


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check.

    Attributes
    ----------
    subject
        One of :data:`SUBJECTS`.
    check
        Name of the check, in words (``mode dial``).
    severity
        How bad it is.
    seen
        What was seen.
    mend
        The way to mend it; empty where there is nothing to mend.
    """

    subject: str
    check: str
    severity: Severity
    seen: str
    mend: str = ""

    @property
    def id(self) -> str:
        """Stable name for machines, e.g. ``camera.mode-dial``."""
        return f"{self.subject}.{self.check.replace(' ', '-')}"

    def as_json(self) -> dict[str, str]:
        """One object of ``doctor --json``'s list."""
        return {"id": self.id, "severity": self.severity.word, "seen": self.seen, "mend": self.mend}


@dataclass(frozen=True, slots=True)
class Subject:
    """Makes findings about one part of the rig."""

    name: str

    def ok(self, check: str, seen: str) -> Finding:
        """All is well."""
        return Finding(self.name, check, Severity.OK, seen)

    def note(self, check: str, seen: str, mend: str = "") -> Finding:
        """Good to know."""
        return Finding(self.name, check, Severity.NOTE, seen, mend)

    def warning(self, check: str, seen: str, mend: str) -> Finding:
        """May spoil a calibration."""
        return Finding(self.name, check, Severity.WARNING, seen, mend)

    def error(self, check: str, seen: str, mend: str) -> Finding:
        """Would stop a calibration."""
        return Finding(self.name, check, Severity.ERROR, seen, mend)

    def failure(self, check: str, error: Exception) -> Finding:
        """An error that a device or a file raised; its message holds what was seen and the way out."""
        seen, mend = split_message(str(error).removeprefix(f"{self.name}: "))
        return self.error(check, seen, mend or "see the error's page in docs/reference")


def split_message(message: str) -> tuple[str, str]:
    """Split ``what: the way out`` or ``what; the way out``; separators in brackets and quotes don't count.

    A bracket at the very end holds a detail of what was seen.
    """
    if match := _DETAIL.fullmatch(message):
        seen, mend = split_message(match[1])
        return (f"{seen} ({match[2]})", mend) if mend else (message, "")
    depth, quoted = 0, False
    for index, letter in enumerate(message):
        if letter in "'`" and (quoted or not message[index - 1 : index].isalnum()):
            quoted = not quoted
        depth += (letter == "(") - (letter == ")")
        if letter in ":;" and depth == 0 and not quoted and message[index + 1 : index + 2] == " ":
            return message[:index], message[index + 2 :]
    return message, ""


_DETAIL = re.compile(r"(.*) \(([^()]*)\)")


@dataclass(frozen=True, slots=True)
class PluggedIn:
    """What can be seen from here, whether rig.yaml names it or not; one text each."""

    cameras: tuple[str, ...] = ()
    serial_ports: tuple[str, ...] = ()
    browsers: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Checkup:
    """All findings about one rig."""

    devices: Mapping[str, str]
    """Kind of camera, stage and panel as rig.yaml names them."""
    findings: tuple[Finding, ...]
    plugged_in: PluggedIn
    versions: Mapping[str, str]
    """Of the workbench, Python and the libraries that matter."""

    @property
    def worst(self) -> Severity:
        """Severity of the worst finding."""
        return max((finding.severity for finding in self.findings), default=Severity.OK)

    @property
    def ready(self) -> bool:
        """Whether nothing would stop a calibration."""
        return self.worst < Severity.ERROR

    def count(self, severity: Severity) -> int:
        """Number of findings that are just as bad."""
        return sum(finding.severity is severity for finding in self.findings)

    def of(self, severity: Severity) -> tuple[Finding, ...]:
        """Findings that are just as bad, in the order of the report."""
        return tuple(finding for finding in self.findings if finding.severity is severity)

    def as_json(self) -> dict[str, Any]:
        """What ``doctor --json`` prints."""
        return {
            "ready": self.ready,
            "worst": self.worst.word,
            "counts": {severity.word: self.count(severity) for severity in Severity},
            "devices": dict(self.devices),
            "plugged_in": {
                "cameras": list(self.plugged_in.cameras),
                "serial_ports": list(self.plugged_in.serial_ports),
                "browsers": list(self.plugged_in.browsers),
            },
            "versions": dict(self.versions),
            "findings": [finding.as_json() for finding in self.findings],
        }


def in_order(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings by subject; within one as they were made."""
    return tuple(sorted(findings, key=lambda finding: SUBJECTS.index(finding.subject)))
