"""Random scenarios with fleets and depots, in batches of one shape: one compilation serves them all."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.planning.instances import traced
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.fleet import make_depots, make_fleet
from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.padding import pad_layout
from uavmec_jax.env.params import Params


def stack(trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def town(
    seed,
    *,
    uavs=4,
    flying=None,
    devices=8,
    padding=0,
    depots=None,
    powered=4,
    connected=4,
    unequal=False,
    more_depots=0,
    **changes,
):
    """Return parameters and layout of a random town.

    Args:
        seed: of the layout and the UAVs' differences.
        uavs: number of UAVs, of which the last ones are padding if fewer are ``flying``.
        flying: UAVs that are not padding.
        devices: number of devices.
        padding: entries of the layout after them.
        depots: see :func:`make_depots`; ``None`` for none.
        powered, connected: numbers of devices.
        unequal: whether UAVs differ in all that they can differ in.
        more_depots: padding after the depots.
        changes: of the parameters.
    """
    rng = np.random.default_rng(seed)
    params = Params(n_devices=devices, max_slots=64, **changes)
    layout = sample_layout(jax.random.key(seed), params, powered, connected)
    factors = {
        name: getattr(params, f"uav_{name}") * np.exp(rng.uniform(-0.4, 0.4, uavs) if unequal else np.zeros(uavs))
        for name in ("speed_m_s", "flying_power_w", "hovering_power_w", "battery_j", "signal_range_m")
    }
    if flying is not None:
        factors["present"] = np.arange(uavs) < flying
    layout = layout.replace(fleet=make_fleet(params, uavs, depots, **factors), depots=depots)
    if more_depots:
        layout = layout.replace(depots=with_padding(depots, more_depots))
    if padding:
        params = params.replace(n_devices=devices + padding)
        layout = pad_layout(layout, devices + padding)
    return traced(params), layout


def with_padding(depots, number):
    """Return the depots with ``number`` entries after them that are padding."""
    far = make_depots([[1e6, 1e6]] * number)
    far = far.replace(pads=jnp.zeros(number), packs=jnp.zeros(number))
    return jax.tree.map(lambda real, padding: jnp.concatenate([real, padding]), depots, far)


def mid_life(seed, params, layout, least=0.02):
    """Return a random state in the middle of an episode; the UAVs are at places or in between, some are grounded."""
    rng = np.random.default_rng(1000 + seed)
    start = initial_state(params, layout)
    real = np.ones(layout.n_devices, bool) if layout.present is None else np.asarray(layout.present)
    places = np.asarray(layout.places())[: layout.n_devices][real]
    if layout.depots is not None:
        places = np.concatenate([places, np.asarray(layout.depots.position)[np.asarray(layout.depots.pads) > 0]])
    position = places[rng.integers(0, len(places), layout.n_uavs)]
    between = rng.random((layout.n_uavs, 1)) < 0.3
    position = np.where(between, rng.uniform(0, 800, (layout.n_uavs, 2)), position)
    grounded = np.asarray(start.grounded) | (rng.random(layout.n_uavs) < 0.1)
    ages = rng.integers(0, 11, layout.n_devices)
    return start.replace(
        battery=jnp.asarray(
            layout.capacity * np.where(real, rng.uniform(0.3, 1.0, layout.n_devices), 1.0), jnp.float32
        ),
        age=jnp.asarray(np.where(layout.has_comms, 0, ages), jnp.int32),
        uav_position=jnp.asarray(position, jnp.float32),
        uav_energy=jnp.asarray(start.uav_energy * rng.uniform(least, 1.0, layout.n_uavs), jnp.float32),
        grounded=jnp.asarray(grounded),
        slot=jnp.int32(rng.integers(0, 30)),
    )
