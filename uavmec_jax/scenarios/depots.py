"""Depots in files: tables ``[[depot]]``."""

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from uavmec_jax.env.fleet import DEPOT_POWER_W, Depots, make_depots
from uavmec_jax.files.validation import StrictModel


class DepotSettings(StrictModel):
    """One depot; see :func:`make_depots`."""

    x_m: float
    y_m: float
    kind: Literal["swap", "charge"] = "swap"
    pads: Annotated[float, Field(ge=1, allow_inf_nan=True)] = math.inf
    packs: Annotated[float, Field(ge=0, allow_inf_nan=True)] = math.inf
    power_w: Annotated[float, Field(ge=0)] = DEPOT_POWER_W


def depots_of(tables: Sequence[DepotSettings]) -> Depots | None:
    """Return the depots that the tables describe; ``None`` if there are none."""
    if not tables:
        return None
    return make_depots(
        [(depot.x_m, depot.y_m) for depot in tables],
        kind=[depot.kind for depot in tables],
        pads=np.array([depot.pads for depot in tables]),
        packs=np.array([depot.packs for depot in tables]),
        power_w=np.array([depot.power_w for depot in tables]),
    )


def check_depots(tables: Sequence[DepotSettings], region_m: tuple[float, float]) -> None:
    """Check that every depot is inside the region.

    Raises:
        ValueError: one line that names the depot.
    """
    for number, depot in enumerate(tables, 1):
        if not (0 <= depot.x_m <= region_m[0] and 0 <= depot.y_m <= region_m[1]):
            raise ValueError(
                f"depot {number} is at {[depot.x_m, depot.y_m]}, outside params.region_m, {list(region_m)}; "
                "give x_m and y_m inside it"
            )
