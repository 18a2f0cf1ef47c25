"""The demand of a scenario with a fleet: :mod:`uavmec_jax.planning.demand` for several UAVs and depots.

Everything stays a relaxation in favour of the network: of UAVs that differ, the fleet counts as if each had the best speed,
powers, range and battery among them; a slot is as short as the fleet's best services could make it without any flight; and
what depots give costs nothing.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from uavmec_jax.env.depots import can_help
from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.planning import demand
from uavmec_jax.planning.demand import SlotCosts

_BEST = {
    "speed_m_s": jnp.max,
    "flying_power_w": jnp.min,
    "hovering_power_w": jnp.min,
    "battery_j": jnp.max,
    "signal_range_m": jnp.max,
}
"""What is best for the network, by field of a fleet."""


def best_uav(params: Params, layout: Layout) -> Params:
    """Return the parameters with a UAV that has the best of every UAV of the fleet; without a fleet, the same ones."""
    if layout.fleet is None:
        return params
    present = jnp.ones(layout.n_uavs, bool) if layout.fleet.present is None else layout.fleet.present
    worst = {jnp.max: -jnp.inf, jnp.min: jnp.inf}
    best: dict[str, Any] = {
        f"uav_{name}": choose(jnp.where(present, getattr(layout.fleet, name), worst[choose]))
        for name, choose in _BEST.items()
    }
    return replace(params, **best)


def is_alone(layout: Layout) -> bool:
    """Return whether a scenario has one UAV and no depots, like the paper's."""
    return layout.n_uavs == 1 and not layout.n_depots


def slot_costs(params: Params, layout: Layout, volumes: Num[Array, "H n"]) -> SlotCosts:
    """Return the costs of every slot of a volume draw as :func:`demand.slot_costs` does; ``volumes`` in bytes.

    The duration does not depend on where the UAVs hover: it is the shortest that services from ``K`` hover points allow.
    """
    params = best_uav(params, layout)
    costs = demand.slot_costs(params, layout, volumes)
    if is_alone(layout):
        return costs
    t_compute = jnp.minimum(volumes / layout.processing_rate, params.slot_cap_s)
    t_results = jnp.where(layout.has_comms, 8.0 * params.result_message_bytes / params.uplink_rate_bit_s, 0.0)
    shortest = jax.vmap(lambda t_work: _shortest_slot(params, layout, t_work))(t_compute + t_results)
    return replace(costs, duration=jnp.broadcast_to(shortest[:, None], costs.duration.shape))


def mean_slot(params: Params, layout: Layout) -> SlotCosts:
    """Return the expected slot as :func:`demand.mean_slot` does, with the duration of :func:`slot_costs`; leaves ``[n]``."""
    params = best_uav(params, layout)
    mean = demand.mean_slot(params, layout)
    if is_alone(layout):
        return mean
    t_compute = jnp.where(layout.active_power > 0, mean.work / jnp.maximum(layout.active_power, 1e-9), 0.0)
    shortest = _shortest_slot(params, layout, jnp.minimum(t_compute, params.slot_cap_s))
    return replace(mean, duration=jnp.broadcast_to(shortest, mean.duration.shape))


def _shortest_slot(params: Params, layout: Layout, t_work: Float[Array, " n"]) -> Float[Array, ""]:
    """Return a lower bound in s on the length of a slot in which unserved devices work for ``t_work``.

    The devices with the longest work cannot all be served if their shares of hover points, as in
    :func:`demand.visit_shares`, sum to more than the number of UAVs; the first one too many is still at work.
    """
    covers = demand.coverage(params, layout)
    present = jnp.ones(layout.n_devices, bool) if layout.present is None else layout.present
    n_covered = jnp.sum(covers & present, axis=1)
    share = 1.0 / jnp.max(jnp.where(covers, n_covered[:, None], 1), axis=0)
    order = jnp.argsort(-t_work)
    taken = jnp.cumsum(jnp.where(present, share, 0.0)[order])
    return jnp.max(jnp.where(taken > layout.n_uavs + 1e-3, t_work[order], 0.0))


def visits_in(
    params: Params, layout: Layout, states: State, slots: Num[ArrayLike, ""], shortest: Float[Array, ""]
) -> Float[Array, " *W"]:
    """Return the most visits that the fleet can make from each state in ``slots`` slots of ``shortest`` s or more.

    Without a depot that helps, a UAV hovers only as long as its energy lasts.
    """
    base, _ = demand.flight_power(best_uav(params, layout))
    lasts = jnp.floor(states.uav_energy * (1.0 + 1e-5) / jnp.maximum(base * shortest, 1e-3))
    each = jnp.where(refills(layout, states)[..., None], slots, jnp.minimum(lasts, slots))
    return jnp.sum(jnp.where(states.grounded, 0.0, each), axis=-1)


def refills(layout: Layout, states: State) -> Bool[Array, " *W"]:
    """Return whether a depot can still help in each state."""
    if layout.depots is None:
        return jnp.zeros(states.slot.shape, bool)
    return jnp.any(can_help(layout.depots, states.packs), axis=-1)
