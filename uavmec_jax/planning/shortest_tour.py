"""The shortest-tour heuristic: visit the devices that lack power or communication in travelling-salesman order."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from uavmec_jax.env.dynamics import State
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params


def shortest_tour(params: Params, layout: Layout, state: State, key: PRNGKeyArray | None = None) -> Array:
    """Fly a short closed tour through the devices that lack power or communication, over and over.

    The tour starts as the nearest-neighbour tour and is improved by 2-opt moves (Croes 1958) until none shortens it. If no
    device lacks anything, all devices are on the tour.
    """
    needy = ~layout.has_power | ~layout.has_comms
    present = True if layout.present is None else layout.present
    needy = jnp.where(jnp.any(needy), needy, present)
    tour = two_opt(layout.position, nearest_neighbour(layout.position, needy), jnp.sum(needy))
    return tour[state.slot % jnp.sum(needy)]


def nearest_neighbour(position: Float[Array, "n 2"], needy: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Return the order that starts at the origin and always visits the nearest remaining needy device; the rest follow."""

    def visit(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        here, remaining = carry
        distance = jnp.linalg.norm(position - here, axis=-1)
        nearest = jnp.argmin(jnp.where(remaining, distance, jnp.where(jnp.any(remaining), jnp.inf, 0.0)))
        return (position[nearest], remaining.at[nearest].set(False)), nearest

    order = jax.lax.scan(visit, (jnp.zeros(2), needy), None, length=needy.shape[0])[1]
    return order.astype(jnp.int32)


def two_opt(position: Float[Array, "n 2"], tour: Int[Array, " n"], size: Int[Array, ""]) -> Int[Array, " n"]:
    """Improve the closed tour ``tour[:size]`` by reversing a segment, the best one first, while that shortens it."""
    rank = jnp.arange(tour.shape[0])
    distance = jnp.linalg.norm(position[:, None] - position[None], axis=-1)

    def gain(tour: Int[Array, " n"]) -> Float[Array, "n n"]:
        """Return the distance in m saved by reversing the segment from position i + 1 to position j of the tour."""
        successor = tour[(rank + 1) % size]
        legs = distance[tour, successor]
        before = legs[:, None] + legs
        after = distance[tour[:, None], tour] + distance[successor[:, None], successor]
        return jnp.where((rank[:, None] < rank) & (rank < size), before - after, -jnp.inf)

    def improve(tour: Int[Array, " n"]) -> Int[Array, " n"]:
        first, last = jnp.divmod(jnp.argmax(gain(tour)), rank.shape[0])
        inside = (rank > first) & (rank <= last)
        return tour[jnp.where(inside, first + 1 + last - rank, rank)]

    # A move must save a millimetre, so that rounding cannot make the search cycle.
    return jax.lax.while_loop(lambda tour: jnp.max(gain(tour)) > 1e-3, improve, tour)
