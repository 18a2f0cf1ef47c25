"""What depots do for the UAVs that have landed: swap their batteries or charge them."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from uavmec_jax.env.fleet import DepotKind, Depots


class DepotService(NamedTuple):
    """What the depots have done in a slot.

    Attributes:
        energy: J, energy in each UAV afterwards.
        packs: full batteries left in stock at each depot.
    """

    energy: Float[Array, " K"]
    packs: Float[Array, " D"]


def stands_at(depots: Depots, position: Float[Array, "K 2"]) -> Bool[Array, "K D"]:
    """Return whether each UAV is exactly at each depot; of several depots in one place, at the first."""
    at = jnp.all(position[:, None] == depots.position, axis=-1)
    return at & (jnp.cumsum(at, axis=1) == 1)


def can_help(depots: Depots, packs: Float[Array, "*W D"]) -> Bool[Array, "*W D"]:
    """Return whether each depot has a pad, and a pack or power."""
    has_energy = jnp.where(depots.kind == DepotKind.SWAP, packs >= 1, depots.power_w > 0)
    return (depots.pads >= 1) & has_energy


def serve_landed(
    depots: Depots,
    packs: Float[Array, " D"],
    landed: Bool[Array, "K D"],
    energy: Float[Array, " K"],
    capacity: Float[Array, " K"],
    seconds: Float[Array, " K"],
) -> DepotService:
    """Swap or charge the batteries of the UAVs that are not full: as many as there are pads, the lowest numbers first.

    Args:
        depots: the depots.
        packs: full batteries in stock.
        landed: which UAV has landed at which depot.
        energy: J in each UAV after its flight.
        capacity: J, of each UAV's battery.
        seconds: time that each UAV spends on the ground.
    """
    swaps = depots.kind == DepotKind.SWAP
    wants = landed & (energy < capacity)[:, None]
    places = jnp.where(swaps, jnp.minimum(depots.pads, jnp.floor(packs)), depots.pads)
    gets = wants & (jnp.cumsum(wants, axis=0) <= places)
    power = jnp.sum(jnp.where(gets & ~swaps, depots.power_w, 0.0), axis=1)
    charged = jnp.minimum(energy + power * seconds, jnp.maximum(energy, capacity))
    return DepotService(
        energy=jnp.where(jnp.any(gets & swaps, axis=1), capacity, charged),
        packs=packs - jnp.sum(gets & swaps, axis=0),
    )
