"""The shortest tour: visit in travelling-salesman order whoever lacks power or communication."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params


def shortest_tour(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Fly a short closed tour through the devices that lack power or communication, over and over.

    The tour is that of the nearest neighbour, improved by 2-opt moves (Croes 1958) until none shortens it. Where every
    device has both, all are on the tour.
    """
    needy = ~layout.has_power | ~layout.has_comms
    everyone = True if layout.present is None else layout.present
    needy = jnp.where(jnp.any(needy), needy, everyone)
    tour = two_opt(layout.position, nearest_neighbour(layout.position, needy), jnp.sum(needy))
    return tour[state.slot % jnp.sum(needy)]


def nearest_neighbour(position: Float[Array, "n 2"], needy: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Order of visits from the origin, always to the nearest device that is left; those not needy come last."""

    def visit(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        place, left = carry
        apart = jnp.linalg.norm(position - place, axis=-1)
        following = jnp.argmin(jnp.where(left, apart, jnp.where(jnp.any(left), jnp.inf, 0.0)))
        return (position[following], left.at[following].set(False)), following

    order = jax.lax.scan(visit, (jnp.zeros(2), needy), None, length=needy.shape[0])[1]
    return order.astype(jnp.int32)


def two_opt(position: Float[Array, "n 2"], tour: Int[Array, " n"], size: Int[Array, ""]) -> Int[Array, " n"]:
    """Reverse stretches of the closed tour ``tour[:size]`` while that shortens it, the best one first."""
    rank = jnp.arange(tour.shape[0])
    apart = jnp.linalg.norm(position[:, None] - position[None], axis=-1)

    def gain(tour: Array) -> Array:
        """``[n, n]`` m saved by reversing the stretch from place i + 1 to place j."""
        following = tour[(rank + 1) % size]
        legs = apart[tour, following]
        now = legs[:, None] + legs
        then = apart[tour[:, None], tour] + apart[following[:, None], following]
        return jnp.where((rank[:, None] < rank) & (rank < size), now - then, -jnp.inf)

    def improve(tour: Array) -> Array:
        first, last = jnp.divmod(jnp.argmax(gain(tour)), rank.shape[0])
        inside = (rank > first) & (rank <= last)
        return tour[jnp.where(inside, first + 1 + last - rank, rank)]

    # A move must save a millimetre, so rounding cannot make the tour go round in circles.
    return jax.lax.while_loop(lambda tour: jnp.max(gain(tour)) > 1e-3, improve, tour)
