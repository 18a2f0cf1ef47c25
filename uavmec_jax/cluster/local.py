"""A Ray cluster of this machine, in processes that end with the process that started them.

Ray starts its daemons by forking, which a process that has imported JAX must not do. So they are started by a small process
of their own, this module run as a program; it ends them when its standard input is closed, as it also is when its parent
is killed.
"""

import logging
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

from uavmec_jax.errors import StudyError


@contextmanager
def local_cluster(n_cpus: int) -> Iterator[str]:
    """Start Ray on this machine; yield its address, and end it afterwards.

    Raises:
        StudyError: Ray does not start.
    """
    command = [sys.executable, "-P", "-m", "uavmec_jax.cluster.local", str(n_cpus)]
    with tempfile.TemporaryFile("w+", encoding="utf-8") as errors:
        keeper = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            start_new_session=True,  # Ctrl-C is for the driver, which then lets the shards save their work
        )
        assert keeper.stdin is not None
        assert keeper.stdout is not None
        try:
            address = keeper.stdout.readline().strip()
            if not address:
                keeper.wait()
                errors.seek(0)
                last = errors.read().strip().rpartition("\n")[2]
                raise StudyError(f"--ray local: Ray does not start on this machine: {last}")
            yield address
        finally:
            keeper.stdin.close()
            keeper.stdout.close()
            keeper.wait()


def main() -> None:
    """Start Ray, print its address, and keep it until standard input is closed."""
    import ray

    ray.init(
        "local", num_cpus=int(sys.argv[1]), include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR
    )
    print(ray.get_runtime_context().gcs_address, flush=True)
    sys.stdin.read()
    ray.shutdown()


if __name__ == "__main__":
    main()
