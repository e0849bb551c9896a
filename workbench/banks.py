"""Banks of a project: store, register, open by reference."""

from __future__ import annotations

from pathlib import Path

from calibration.bank import Bank, load_bank, save_bank
from calibration.errors import BankError
from calibration.registry import Entry, activate, read_registry, register
from workbench.project import Project


def store_bank(project: Project, bank: Bank) -> tuple[Entry, Path]:
    """Write a bank, give it a version and make it the active one; an identical bank keeps its version."""
    directory = save_bank(bank, project.banks)
    register(project.banks, directory.name)
    return activate(project.banks, directory.name), directory


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
