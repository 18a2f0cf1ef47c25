"""A limit on the time of a part of a test that would otherwise wait for ever."""

import signal
from contextlib import contextmanager


@contextmanager
def within(seconds):
    """Fail what takes longer, even where it waits in a system call."""

    def fail(*_):
        raise AssertionError(f"took longer than {seconds} s")

    before = signal.signal(signal.SIGALRM, fail)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
