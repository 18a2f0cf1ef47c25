"""Ray for the tests: one cluster on this machine, and workers that are killed."""

import threading
import time
from contextlib import contextmanager

import psutil

from uavmec_jax.cluster.options import RayOptions

TWO_CORES = RayOptions(cpus_per_shard=2, retries=1)
"""A shard has as many devices as the tests' own process, so that the partitions are the same."""


def worker_of(task):
    """The process that works on a task, or ``None``; Ray names processes after their tasks."""
    for process in psutil.Process().children(recursive=True):
        try:
            if process.cmdline()[:1] == [f"ray::shard-{task}"]:
                return process
        except psutil.Error:
            continue
    return None


@contextmanager
def killed_worker(task, after=lambda: True, seconds=60):
    """Kill the process of a task once, as soon as it works on the task and ``after()`` holds.

    Yields a list that then holds the process.
    """
    killed, over = [], threading.Event()

    def watch():
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and not over.is_set():
            process = worker_of(task) if after() else None
            if process is not None:
                process.kill()
                killed.append(process)
                return
            time.sleep(0.02)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield killed
    finally:
        over.set()
        thread.join()
