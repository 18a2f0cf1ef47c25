"""How scenarios with fleets, depots and horizons differ from those that policies were trained on."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from uavmec_jax.env.fleet import make_depots, make_fleet
from uavmec_jax.env.generator import ScenarioDistribution
from uavmec_jax.env.layout import sample_layout
from uavmec_jax.env.params import Params
from uavmec_jax.scenarios.distribution import ScenarioSettings, check_scenarios, out_of_distribution
from uavmec_jax.scenarios.settings import ParamsSettings

SCENARIOS = ScenarioSettings().model_dump()
TRAINED = ParamsSettings(n_devices=16).model_dump()
BEFORE_HORIZONS = {name: value for name, value in TRAINED.items() if name not in ("end", "horizon_s", "end_share")}


def differences(trained=TRAINED, params=None, **changes):
    params = params or Params()
    layout = replace(sample_layout(jax.random.key(0), params, 8, 8), **changes)
    return out_of_distribution(SCENARIOS, trained, params, layout)


@pytest.mark.parametrize("trained", [TRAINED, BEFORE_HORIZONS], ids=["now", "before horizons"])
def test_a_horizon_is_named(trained):
    assert differences(trained, Params(horizon_s=60.0)) == []  # of no meaning where the first failure ends the episode
    ends = "end: horizon; it was trained on first_failure"
    assert differences(trained, Params(end="horizon")) == [ends]
    assert differences(TRAINED, Params(end="horizon", horizon_s=60.0)) == [
        ends,
        "horizon_s: 60.0; it was trained on 43200.0",
    ]


def test_fleets_and_depots_are_named():
    params = Params()
    depots = make_depots([[100.0, 3000.0]])
    assert differences(fleet=make_fleet(params, 1)) == []
    assert differences(fleet=make_fleet(params, 2), depots=depots) == [
        "extent in m: 3,000; it was trained on 0 to 2,500",
        "UAVs: 2; it was trained on 1",
        "depots: 1; it was trained on 0",
    ]
    fleet = make_fleet(params, 2, battery_j=np.array([1.6e6, 9e6]), hovering_power_w=np.array([80.0, 90.0]))
    assert differences(fleet=fleet)[1:] == [
        "the UAV's battery in J: 1.6e+06 to 9e+06; it was trained on 1.12e+06 to 2.24e+06",
        "uav_hovering_power_w: 80 to 90; it was trained on 80.0",
    ]


def test_typical_scenarios_have_as_many_devices_as_any():
    check_scenarios(ScenarioSettings(typical_devices=300, typical_least=100, devices=(4, 300)), 300)
    assert ScenarioDistribution.__dataclass_fields__["typical_devices"].metadata["le"] == 1000
