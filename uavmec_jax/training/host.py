"""The machine a run happens on: its cores, memory and versions."""

import hashlib
import importlib
import os
import platform
import sys
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import psutil

from uavmec_jax.errors import StudyError

MEMORY_SHARE = 0.8
"""Share of the free memory that a run may plan with."""


def use_all_cores(share: tuple[int, int] | None = None) -> None:
    """Make every CPU core a device of its own; call before JAX is first used.

    Agents are split over the devices, and each then works in its own core's cache: nearly twice as fast as one device
    that spreads every small operation over the cores. Without effect once JAX has started, or if the user has already
    set a number of devices.

    Args:
        share: ``(i, n)``: keep to the i-th of n equal parts of the cores (at least one), from 1.
    """
    if hasattr(os, "sched_getaffinity"):
        mine = sorted(os.sched_getaffinity(0))
        if share is not None:
            part = max(len(mine) // share[1], 1)
            first = (share[0] - 1) * part % len(mine)
            mine = mine[first : first + part]
            os.sched_setaffinity(0, mine)
        cores = len(mine)
    else:
        cores = max((os.cpu_count() or 1) // (share[1] if share else 1), 1)
    if "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", ""):
        return
    try:
        jax.config.update("jax_num_cpu_devices", cores)
    except RuntimeError:  # the backend is already running
        return


def free_memory() -> int:
    """Bytes a population may use on this host's devices together."""
    devices = jax.local_devices()
    if devices[0].platform == "cpu":
        return int(MEMORY_SHARE * psutil.virtual_memory().available)
    stats = [device.memory_stats() or {} for device in devices]
    return int(MEMORY_SHARE * sum(s.get("bytes_limit", 0) - s.get("bytes_in_use", 0) for s in stats))


def processor() -> str:
    """Name of the processor, as well as the system tells it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            for line in lines:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    """Of what decides over the bits of a run."""
    packages = ("uavmec-jax", "jax", "jaxlib", "flax", "optax", "numpy", "scipy", "pandas")
    return {name: version(name) for name in packages}


@cache
def code_digest() -> str:
    """SHA-256 of this package's source files."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1]
    for file in sorted(root.rglob("*.py")):
        digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def describe() -> dict[str, Any]:
    """Versions and hardware, for ``run.json`` and ``uavmec doctor``."""
    return {
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "versions": versions(),
        "processor": processor(),
        "cores": psutil.cpu_count() or 1,
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "free_memory_gib": round(psutil.virtual_memory().available / 2**30, 1),
        "backend": jax.default_backend(),
        "devices": [f"{device.platform}:{device.id} {device.device_kind}" for device in jax.local_devices()],
    }


def optional(module: str, needed_by: str, extra: str) -> Any:
    """A module of a package that only comes with an extra.

    Raises:
        StudyError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise StudyError(
            f"{needed_by} needs the package {module}, which is not installed: pip install 'uavmec-jax[{extra}]'"
        ) from None


def version(name: str) -> str:
    """Of an installed package, or that it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"
