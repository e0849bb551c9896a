"""Expected errors of the workbench itself; with those of calibration and rigs they become exit codes in one place."""

from __future__ import annotations


class WorkbenchError(Exception):
    """Base: expected, told in one line that names the thing and the way out."""


class InputError(WorkbenchError):
    """What the operator gave can't be used (exit code 2)."""


class CheckFailedError(WorkbenchError):
    """Everything ran, and a check said no (exit code 3)."""
