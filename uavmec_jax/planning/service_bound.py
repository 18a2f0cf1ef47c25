"""An upper bound on the time in service until a horizon, whatever the UAVs do."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.scenario_checks import check_scenario

_SLACK = 1e-5
"""Relative tolerance for the single precision of the slot's physics, in favour of the network."""


def service_bound(params: Params, layout: Layout) -> Float[Array, ""]:
    """Return the largest share of the time to the horizon in which the devices can be in service.

    A device without power that is in service after a slot has a battery that is not empty then. In every slot up to there it
    has drawn its standby power for the whole slot, and for its work or its upload no less than nothing. So the slots in
    which it is in service take less than ``capacity / standby_power`` together, whatever the UAVs do, and never more than the
    time to the horizon. The share is the mean over the devices, weighted as in :func:`uavmec_jax.env.dynamics.service`.

    Args:
        params: scenario parameters; ``end`` need not be ``"horizon"``, ``horizon_s`` is the time.
        layout: the devices, with full batteries; UAVs and depots make no difference. Use ``vmap`` for several.

    Raises:
        ArgumentError: something is not finite or out of range, and a bound would certify nothing; one line. Traced values
            are checked only inside :func:`um.debug_checks`.
    """
    check_scenario(params, layout)
    drains = ~layout.has_power & (layout.standby_power > 0)
    lasts = layout.capacity * (1.0 + _SLACK) / jnp.where(drains, layout.standby_power, 1.0)
    share = jnp.where(drains, jnp.minimum(lasts / params.horizon_s, 1.0), 1.0)
    weight = layout.service_weight()
    total = jnp.sum(weight)
    return jnp.sum(weight * share) / jnp.where(total > 0, total, 1.0)
