"""The one place that knows how pixel loops are compiled: numba, cached on disk so that the next start is quick."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

_FREEDOM = {"contract", "nsz", "arcp", "reassoc"}
"""What the compiler may do to floating point so that loops vectorise; infinities and NaN keep their meaning."""

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """Compile a loop over arrays to machine code; it runs without Python's lock, so that threads may share the rows."""
    return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_FREEDOM)(function))
