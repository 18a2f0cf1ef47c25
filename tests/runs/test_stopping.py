"""Signals end a run between two chunks, or at once where it can be interrupted."""

import os
import signal

import pytest

from uavmec_jax.runs.signals import Interrupted, StopSignal


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_recorded_and_the_second_one_interrupts(number):
    before = signal.getsignal(number)
    with StopSignal() as stop:
        stop.check()
        os.kill(os.getpid(), number)
        with pytest.raises(Interrupted) as stopped:
            stop.check()
        assert stopped.value.signal == number
        with pytest.raises(Interrupted):
            os.kill(os.getpid(), number)
    assert signal.getsignal(number) == before


def test_a_signal_interrupts_an_interruptible_section():
    def work(stop, early):
        if early:
            os.kill(os.getpid(), signal.SIGTERM)
        with stop.interruptible():
            os.kill(os.getpid(), signal.SIGTERM)
            raise AssertionError("too late")

    for early in (False, True):
        with StopSignal() as stop, pytest.raises(Interrupted):
            work(stop, early)
