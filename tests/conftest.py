"""For all tests: one thread of linear algebra per process, since tests run side by side; Ctrl-C is heard."""

from __future__ import annotations

import os
import signal
from contextlib import suppress

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")  # before anything imports NumPy

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's background job; programs that we start inherit it
    with suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # under nohup
    with suppress(ValueError):
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
