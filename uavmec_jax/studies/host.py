"""The machine a run happens on: its cores, memory and versions."""

import os
import platform
import sys
from importlib import metadata
from typing import Any

import jax
import psutil

MEMORY_SHARE = 0.8
"""Share of the free memory that a run may plan with."""


def use_every_core() -> None:
    """Make every CPU core a device of its own; call before JAX is first used.

    Agents are split over the devices, and each then works in its own core's cache: nearly twice as fast as one device
    that spreads every small operation over the cores. Without effect once JAX has started, or if the user has already
    set a number of devices.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
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


def describe() -> dict[str, Any]:
    """Versions and hardware, for ``run.json`` and ``uavmec doctor``."""
    packages = ("uavmec-jax", "jax", "jaxlib", "flax", "optax", "numpy", "scipy", "pandas")
    return {
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "versions": {name: version(name) for name in packages},
        "processor": processor(),
        "cores": psutil.cpu_count() or 1,
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "free_memory_gib": round(psutil.virtual_memory().available / 2**30, 1),
        "backend": jax.default_backend(),
        "devices": [f"{device.platform}:{device.id} {device.device_kind}" for device in jax.local_devices()],
    }


def version(name: str) -> str:
    """Of an installed package, or that it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"
