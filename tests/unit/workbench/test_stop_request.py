import contextlib
import signal

import pytest

from workbench.session import StopRequest


def _swallow_an_interrupt(stop: StopRequest) -> None:
    with stop.heard():
        with contextlib.suppress(KeyboardInterrupt):  # as a callback from compiled code does
            signal.raise_signal(signal.SIGINT)
        stop.check()
        pytest.fail("the interrupt was lost")


def test_an_interrupt_that_is_swallowed_still_counts_at_the_next_check() -> None:
    with pytest.raises(KeyboardInterrupt):
        _swallow_an_interrupt(StopRequest())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_what_else_ends_a_program_is_heard_as_an_interrupt(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), StopRequest().heard():
        signal.raise_signal(number)
    assert signal.getsignal(number) is before


def test_a_hangup_that_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopRequest().heard():
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_the_handler_of_before_is_back_afterwards() -> None:
    before = signal.getsignal(signal.SIGINT)
    with StopRequest().heard():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before
