"""What the devices require of the hover sets: that no battery runs out, and that no data expire."""

import numpy as np
from jaxtyping import Bool, Float, Int

from uavmec_jax.planning.bound_instance import SLACK, Instance
from uavmec_jax.planning.requirements import Rows


def add_battery_rows(rows: Rows, instance: Instance, shortest: Float[np.ndarray, " H"], survive: int) -> bool:
    """Add the rows of the batteries: energy, and whole visits with the largest savings counted first.

    Args:
        rows: where to.
        instance: the scenario.
        shortest: s, least length of each slot.
        survive: slots that the devices survive.

    Returns:
        Whether the batteries can last; they cannot if one runs out even with a service in every slot.
    """
    slots = np.arange(survive)
    slot, size = (index.ravel() for index in np.indices((survive, rows.features.sizes)))
    seconds, use = rows.features.seconds(slot, size), rows.features.use(slot, size)
    for device in np.flatnonzero(~instance.has_power):
        capacity, standby = instance.capacity[device] * (1.0 + SLACK), instance.standby_power[device]
        work, upload = instance.work[:survive, device], instance.upload[:survive, device]
        saving = work - upload
        services = rows.features.service(slots, np.full(survive, device))
        drain = (seconds, np.full(len(slot), standby / capacity)), (use, work[slot] / capacity)
        rows.add(1.0, *drain, (services, -(np.maximum(saving, 0.0) if instance.may_decline else saving) / capacity))
        saved = np.cumsum(np.sort(np.maximum(saving, 0.0))[::-1])
        missing = np.sum(standby * shortest[:survive] + work) - capacity
        visits = 0 if missing < 0 else 1 + int(np.sum(saved <= missing))
        if visits > survive:
            return False
        if visits:
            rows.add(-float(visits), (services, np.full(survive, -1.0)))
    return True


def add_age_rows(rows: Rows, instance: Instance, survive: int) -> None:
    """Add the rows of the data: any ``slots_to_expiry`` slots serve each device without communication."""
    window = np.arange(instance.slots_to_expiry)
    for device in _hardest(np.flatnonzero(~instance.has_comms), instance.covers[instance.hover_points]):
        for start in range(survive - instance.slots_to_expiry + 1):
            services = rows.features.service(start + window, np.full(len(window), device))
            rows.add(-1.0, (services, np.full(len(window), -1.0)))


def _hardest(devices: Int[np.ndarray, " d"], covers: Bool[np.ndarray, "q n"]) -> list[int]:
    """Return the devices without those that are served whenever another one is; of equal ones the first."""
    columns = covers[:, devices]
    # with_other[i, j]: every hover point that serves i serves j.
    with_other = ~np.any(columns[:, :, None] & ~columns[:, None], axis=0)
    earlier = np.tri(len(devices), k=-1, dtype=bool).T
    implied = np.any(with_other & (earlier | ~with_other.T), axis=0)
    return [int(device) for device in devices[~implied]]
