"""The machine that a run is on: its cores, memory and software versions."""

import hashlib
import os
import platform
import sys
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import psutil

from uavmec_jax.cluster.connection import n_cores
from uavmec_jax.errors import StudyError

MEMORY_SHARE = 0.8
"""Share of the free memory that a run may use."""


def use_all_cores(most: int | None = None) -> None:
    """Make every CPU core a JAX device. Call this before JAX is first used.

    Agents are split over the devices, so that each core works in its own cache. This is nearly twice as fast as a single
    device that spreads every small operation over all cores. The call has no effect once JAX has started, or if the user
    has already set a number of devices.

    Args:
        most: use no more cores than this.
    """
    if "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", ""):
        return
    try:
        jax.config.update("jax_num_cpu_devices", min(n_cores(), most or n_cores()))
    except RuntimeError:  # the backend is already running
        return


def use_devices(cpus: int, gpus: int) -> None:
    """Make JAX use so many cores, or so many GPUs. Call this before JAX is first used.

    Raises:
        StudyError: GPUs are wanted and JAX sees another number of them.
    """
    if not gpus:
        jax.config.update("jax_platforms", "cpu")
        use_all_cores(cpus)
    elif jax.default_backend() == "cpu" or jax.local_device_count() != gpus:
        raise StudyError(f"JAX sees {jax.local_device_count()} x {jax.default_backend()} where {gpus} GPUs are wanted")


def free_memory() -> int:
    """Return the number of bytes that a population may use on all local devices together."""
    devices = jax.local_devices()
    if devices[0].platform == "cpu":
        return int(MEMORY_SHARE * psutil.virtual_memory().available)
    stats = [device.memory_stats() or {} for device in devices]
    return int(MEMORY_SHARE * sum(s.get("bytes_limit", 0) - s.get("bytes_in_use", 0) for s in stats))


def processor() -> str:
    """Return the name of the processor; where the system does not tell it, its architecture."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            for line in lines:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    """Return the versions of the packages on which the numbers of a run depend."""
    packages = ("uavmec-jax", "jax", "jaxlib", "flax", "optax", "numpy", "scipy", "pandas")
    return {name: version(name) for name in packages}


@cache
def code_digest() -> str:
    """Return the SHA-256 of this package's source files."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1]
    for file in sorted(root.rglob("*.py")):
        digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def code() -> dict[str, str]:
    """Return what the bits of a run depend on besides its plan and the processor: this package's code, and the versions."""
    return {"uavmec_jax's code": code_digest()} | versions()


def code_differences(then: dict[str, str]) -> list[str]:
    """List how the code here differs from another one that :func:`code` returned, then or elsewhere."""
    now = code()
    return [f"{name} {then.get(name, '?')[:12]} -> {now[name][:12]}" for name in now if now[name] != then.get(name)]


def describe() -> dict[str, Any]:
    """Return versions and hardware as plain data, for ``run.json`` and ``uavmec doctor``."""
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


def version(name: str) -> str:
    """Return the version of a package, or ``not installed``."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"
