import contextlib
import signal

import pytest

from workbench.session import StopRequest

ENDING = pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])


def _swallow_an_interrupt(stop: StopRequest, kind: signal.Signals) -> None:
    with stop.heard():
        with contextlib.suppress(KeyboardInterrupt):  # as a callback from compiled code does
            signal.raise_signal(kind)
        stop.check()
        pytest.fail("the interrupt was lost")


@ENDING
def test_an_interrupt_that_is_swallowed_still_counts_at_the_next_check(kind: signal.Signals) -> None:
    with pytest.raises(KeyboardInterrupt):
        _swallow_an_interrupt(StopRequest(), kind)


@ENDING
def test_the_handler_of_before_is_back_afterwards(kind: signal.Signals) -> None:
    before = signal.getsignal(kind)
    with StopRequest().heard():
        assert signal.getsignal(kind) is not before
    assert signal.getsignal(kind) is before


def test_a_hangup_that_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopRequest().heard():
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
