"""Small random instances that can be solved exactly; they cover every reading of the model."""

import jax
import numpy as np

from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import volume_table

SLOTS = 64


def small_instance(seed: int, *, devices: int | None = None, readings: bool = True):
    """Return parameters, layout, volume key and volume table of an instance with 3 to 5 devices and a short lifetime."""
    rng = np.random.default_rng(seed)
    n = devices or int(rng.integers(3, 6))
    side = float(rng.choice([80.0, 200.0, 800.0]))
    low = float(rng.uniform(3e3, 2e4))
    other = rng.random(3) < 0.3 if readings else np.zeros(3, bool)
    params = Params(
        n_devices=n,
        region_m=(side, side),
        data_age_limit_slots=int(rng.integers(1, 6)),
        device_battery_range_j=(low, 1.6 * low),
        uav_battery_j=float(rng.uniform(1.5e5, 8e5)),
        flight_power_adds_to_hover=bool(other[0]),
        age_at_limit_fails=bool(other[1]),
        count_unfinished_slot=bool(other[2]),
        uav_speed_m_s=float(rng.choice([0.5, 5.0])),
        uav_flying_power_w=float(rng.choice([40.0, 150.0])),
        max_slots=SLOTS,
    )
    layout = sample_layout(jax.random.key(seed), params, int(rng.integers(0, n)), int(rng.integers(0, n)))
    key = jax.random.key(1000 + seed)
    return params, layout, key, volume_table(params, n, key, SLOTS)


def traced(params: Params) -> Params:
    """Return the parameters as arrays, so that all instances share one compilation."""
    return jax.tree.map(lambda leaf: np.float32(leaf) if isinstance(leaf, float) else np.asarray(leaf), params)
