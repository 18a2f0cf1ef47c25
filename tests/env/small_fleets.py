"""Small fleets whose slots can be worked out by hand, on the layout ``three_devices``.

Device 0 is at (30, 40), device 1 at (30, 100), in range of device 0, and device 2 at (330, 440). Every task is 3 MB: 300 s of
computing for each device, 3 s for the devices of QUICK. An upload takes 0.120395 s to a UAV above the device and 1.516768 s
between device 0 and a UAV above device 1, or the other way round (test_dynamics.py). A UAV flies at 5 m/s, for 150 W, and
hovers for 80 W. ORIGIN, where depots are put, is 50 m or 10 s from device 0 and 550 m from device 2; NORTH is far from all.
"""

import jax
import jax.numpy as jnp

from tests.small_scenarios import three_devices
from uavmec_jax.env.dynamics import initial_state, transition
from uavmec_jax.env.fleet import make_fleet
from uavmec_jax.env.params import Params

PARAMS = Params(n_devices=3)
HORIZON = Params(n_devices=3, end="horizon")
SLOW = three_devices()
QUICK = three_devices(processing_rate=jnp.full(3, 1e6))
DEVICE_0, DEVICE_1, DEVICE_2 = (30.0, 40.0), (30.0, 100.0), (330.0, 440.0)
ORIGIN, NORTH = (0.0, 0.0), (330.0, 840.0)
FULL = 1_600_000.0
VOLUMES = jnp.full(3, 3e6)

step = jax.jit(transition)


def fleet_layout(uavs, depots=None, base=SLOW, **values):
    return base.replace(fleet=make_fleet(PARAMS, uavs, depots, **values), depots=depots)


def play(layout, action, at=None, params=PARAMS, **changes):
    """Play a slot; ``at`` are the UAVs' positions, ``changes`` are fields of the state."""
    if at is not None:
        changes["uav_position"] = at
    state = initial_state(params, layout)
    kinds = {name: getattr(state, name).dtype for name in changes}
    state = state.replace(**{name: jnp.array(value, kinds[name]) for name, value in changes.items()})
    return step(params, layout, state, jnp.array(action, jnp.int32), VOLUMES)
