"""What the process of a task needs: the name of its node, and an end if it hangs."""

import faulthandler
import socket
from collections.abc import Iterator
from contextlib import contextmanager


def node_name() -> str:
    """Return the name of this node: its host and the beginning of Ray's identity of it."""
    import ray

    return f"{socket.gethostname()}/{ray.get_runtime_context().get_node_id()[:8]}"


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """End this process if it is still inside after so many seconds, whatever it is doing."""
    if seconds is None:
        yield
        return
    faulthandler.dump_traceback_later(seconds, exit=True, file=2)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
