"""How work is put on Ray. The command line reads its defaults from here, so nothing heavy is imported."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from uavmec_jax.errors import ArgumentError, StudyError

_MOST = 1_000_000
"""Most cores, GPUs and retries."""

LOCAL = "local"
"""The address that starts Ray on this machine."""


@dataclass(frozen=True)
class RayOptions:
    """Which cluster does the work, and what each shard needs.

    Attributes:
        address: of a cluster: ``host:port``, ``ray://host:port``, or ``auto`` for the one that this machine belongs to;
            ``local`` starts one on this machine, with its cores; ``None`` joins the cluster that the environment variable
            ``RAY_ADDRESS`` names, and starts one on this machine if it is not set.
        cpus_per_shard: cores of a shard; by default those of this machine, and 1 if a shard has GPUs.
        gpus_per_shard: GPUs of a shard.
        resources: custom resources of Ray that a shard needs, by name.
        retries: how often a shard is tried again after an error of the program. Nodes that die do not count.
        time_limit_s: seconds after which an attempt at a shard is ended and made anew from the last checkpoint.
    """

    address: str | None = None
    cpus_per_shard: int | None = None
    gpus_per_shard: int = 0
    resources: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    retries: int = 2
    time_limit_s: float | None = None

    def __post_init__(self) -> None:
        for name, least in (("cpus_per_shard", 1), ("gpus_per_shard", 0), ("retries", 0)):
            value = getattr(self, name)
            whole = isinstance(value, int) and not isinstance(value, bool)
            if not (value is None and name == "cpus_per_shard") and not (whole and least <= value <= _MOST):
                raise ArgumentError(f"{name} is {value!r}; it should be a whole number from {least} to {_MOST:,}")
        limit = self.time_limit_s
        if limit is not None and not (isinstance(limit, int | float) and 0 < limit < math.inf):
            raise ArgumentError(f"time_limit_s is {limit!r}; it should be a finite number of seconds above 0")

    @classmethod
    def of(cls, ray: "RayOptions | str | bool | None") -> "RayOptions | None":
        """Return the options that a caller means: ``True`` for the defaults, an address, options, or none.

        Raises:
            StudyError: it is something else.
        """
        if isinstance(ray, str):
            return cls(address=ray)
        if isinstance(ray, cls):
            return ray
        if ray is None or isinstance(ray, bool):
            return cls() if ray else None
        raise StudyError(f"ray is {ray!r}; give True, an address or um.RayOptions(...)")
