"""Banks of a project: store, register, open by reference."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from calibration.bank import Bank, load_bank, save_bank
from calibration.errors import BankError
from calibration.registry import Entry, next_version, read_registry, register
from workbench.files import made_directory
from workbench.project import Project


@dataclass(frozen=True, slots=True)
class StoredBank:
    """Where a bank lies, and what it is called."""

    entry: Entry
    directory: Path
    report: Path


def quality_verdict(bank: Bank) -> str:
    """good, suspect or bad; unknown for imported PSFs, which nobody has judged."""
    return str(bank.manifest.get("quality", {}).get("verdict", "unknown"))


def is_bad(bank: Bank) -> bool:
    """Whether a bank's quality figures say that nobody should measure with it unseen."""
    return quality_verdict(bank) == "bad"


def quality_reasons(bank: Bank, most: int = 3) -> str:
    """Why a bank's quality is what it is, in one line: the first reasons, and how many more there are."""
    reasons = list(bank.manifest.get("quality", {}).get("reasons", ()))
    more = f"; and {len(reasons) - most} more" if len(reasons) > most else ""
    return "; ".join(reasons[:most]) + more


def store_bank(project: Project, bank: Bank) -> StoredBank:
    """Write a bank and its report, and give it a version; an identical bank keeps its version.

    It becomes the active one unless its quality is bad: that is for somebody who has looked at it to decide.

    Raises
    ------
    BankError, OSError
        It can't be written, or is one that was revoked; nothing is left behind.
    """
    from workbench.report import write_bank_report  # drawing is slow to import, and listing banks needs none

    with made_directory(project.banks):
        directory = project.banks / bank.id
        is_new = not directory.exists()
        try:
            save_bank(bank, project.banks)
            report = directory / "report.html"
            write_bank_report(bank, report, version=f"v{next_version(project.banks, bank.id)}")
            entry = register(project.banks, bank.id, active=not is_bad(bank))
        except BaseException:
            if is_new:
                shutil.rmtree(directory, ignore_errors=True)
            raise
    return StoredBank(entry, directory, report)


def resolve(project: Project, reference: str) -> Entry:
    """Registry entry of a bank id, version or ``active``."""
    return read_registry(project.banks).resolve(reference)


def open_bank(project: Project, reference: str) -> tuple[Bank, Entry]:
    """Load and verify the bank that a reference means.

    Raises
    ------
    BankError
        Unknown, revoked or damaged.
    """
    entry = resolve(project, reference)
    if entry.revoked:
        raise BankError(
            f"bank v{entry.version} {entry.id} is revoked ({entry.revoked_reason or 'no reason given'}); choose another"
        )
    return load_bank(project.banks / entry.id), entry
