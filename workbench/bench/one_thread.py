"""Work in processes of one thread each, so that times are those of one core."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, TypeVar

import cv2

from calibration.bank import Bank

Result = TypeVar("Result")

_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Limits that processes started within inherit and read when they load their libraries."""
    before = {name: os.environ.get(name) for name in _LIMITS}
    os.environ.update(dict.fromkeys(_LIMITS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def start_in_one_thread() -> None:
    """What such a process does first; it ends with its parent, for which it would wait for ever were that killed."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def sendable(bank: Bank) -> Bank:
    """The bank without read-only mappings, which can't be sent to a process."""
    return replace(bank, manifest=dict(bank.manifest), extras=dict(bank.extras))


def in_one_thread(function: Callable[..., Result], *arguments: Any, **named: Any) -> Result:
    """Call a function of a module in a process of one thread; what it takes and gives is sent there and back."""
    context = multiprocessing.get_context("spawn")  # forking a process that has threads may deadlock
    with one_thread_each(), ProcessPoolExecutor(1, context, start_in_one_thread) as pool:
        return pool.submit(function, *arguments, **named).result()
