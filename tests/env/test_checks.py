"""Calls with values that cannot be are refused in one line; compiled programs check theirs inside ``debug_checks`` only."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import uavmec_jax as um
from tests.env.small_fleets import ORIGIN, fleet_layout
from uavmec_jax.env.checks import Bounds, check_bool, check_range
from uavmec_jax.env.fleet import make_depots, make_fleet
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.padding import pad_layout
from uavmec_jax.env.rewards import make_reward
from uavmec_jax.env.rollout import returns, rollout_from, trace, volume_table
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.env.slot_checks import check_volumes
from uavmec_jax.planning.heuristics import HEURISTICS

KEY = jax.random.key(0)
PARAMS = um.Params()
LAYOUT = um.sample_layout(KEY, PARAMS, 8, 8)
SCENARIO = um.make_scenario(LAYOUT, PARAMS)
STATE = um.initial_state(PARAMS, LAYOUT)
VOLUMES = jnp.full(12, 3e6)
STAY = HEURISTICS["stay-put"]
ENV = um.UavMecEnv()
SLOT = jax.jit(um.transition)
PLACES = "it should be a whole number from 0 to 11"


def refused(line):
    return pytest.raises(um.ArgumentError, match=line)


def layout(**changes) -> Layout:
    """Return the layout with single values changed: ``capacity=(3, 0.0)`` for the device of index 3."""
    return LAYOUT.replace(**{name: getattr(LAYOUT, name).at[at].set(to) for name, (at, to) in changes.items()})


@pytest.mark.parametrize("action", [99, -1, 2.5, np.int64(12), jnp.int32(-1), jnp.float32(2.0), True, 10**30])
@pytest.mark.parametrize(
    "play",
    [
        lambda action: um.transition(PARAMS, LAYOUT, STATE, action, VOLUMES),
        lambda action: ENV.step(KEY, STATE, action, SCENARIO),
        lambda action: ENV.step(KEY, STATE, action),
    ],
    ids=["transition", "step", "step of the default scenario"],
)
@pytest.mark.usefixtures("without_type_checks")
def test_an_action_that_is_no_place_is_refused(play, action):
    with refused(rf"^action is .*; {PLACES}$"):
        play(action)


def test_an_action_of_one_uav_of_a_fleet_is_named():
    fleet = fleet_layout(2, make_depots([ORIGIN]))
    params = um.Params(n_devices=3)
    with refused(r"^action of UAV 2 is 4; it should be a whole number from 0 to 3$"):
        um.transition(params, fleet, um.initial_state(params, fleet), jnp.array([3, 4]), jnp.full(3, 3e6))


@pytest.mark.parametrize("count", [99, -1, 2.5, 13, float("nan"), jnp.int32(-1)])
def test_a_number_of_devices_that_cannot_be_is_refused(count):
    with refused(r"n_powered is .*; it should be a whole number from 0 to 12$"):
        um.sample_layout(KEY, PARAMS, count, 8)
    with refused(r"n_connected is .*; it should be a whole number from 0 to 12$"):
        um.sample_layout(KEY, PARAMS, 8, count)


PARAMETERS = {
    "negative speed": (
        {"uav_speed_m_s": -5.0},
        r"params\.uav_speed_m_s is -5; it should be a finite number from 1e-06 to 1e\+12",
    ),
    "speed that is 0 in float32": ({"uav_speed_m_s": 1e-300}, r"params\.uav_speed_m_s is 1e-300"),
    "infinite battery": ({"uav_battery_j": float("inf")}, r"params\.uav_battery_j is inf"),
    "huge battery": ({"uav_battery_j": 1e300}, r"params\.uav_battery_j is 1e\+300"),
    "NaN in an array": ({"slot_cap_s": jnp.float32(jnp.nan)}, r"params\.slot_cap_s is nan"),
    "region": ({"region_m": (800.0, float("nan"))}, r"params\.region_m \(value 2\) is nan"),
    "falling range": (
        {"task_volume_range_bytes": (4e6, 2e6)},
        r"params\.task_volume_range_bytes is \(4000000.0, 2000000.0\)",
    ),
    "capacity of 1e-300": ({"device_battery_range_j": (1e-300, 1e4)}, r"device_battery_range_j \(value 1\) is 1e-300"),
    "no device": ({"n_devices": 0}, r"params\.n_devices is 0; it should be a whole number from 1 to 1000"),
    "end": ({"end": "never"}, r"params\.end is 'never'; it should be 'first_failure' or 'horizon'"),
    "age limit": (
        {"data_age_limit_slots": -1},
        r"params\.data_age_limit_slots is -1; it should be a finite number from 0",
    ),
}


@pytest.mark.parametrize(("changes", "line"), PARAMETERS.values(), ids=PARAMETERS)
def test_parameters_that_cannot_be_are_refused(changes, line):
    params = um.Params(**changes)
    with refused(line):
        um.sample_layout(KEY, params, 0, 0)
    if "n_devices" not in changes:
        with refused(line):
            um.initial_state(params, LAYOUT)
        with refused(line):
            um.rollout(STAY, params, LAYOUT, KEY)
        with refused(line):
            ENV.reset(KEY, Scenario(params, LAYOUT, SCENARIO.reward))


LAYOUTS = {
    "NaN position": (layout(position=((3, 1), jnp.nan)), r"layout\.position of device 4 is nan; it should be a finite"),
    "infinite position": (layout(position=((0, 0), jnp.inf)), r"layout\.position of device 1 is inf"),
    "no capacity": (
        layout(capacity=(11, 0.0)),
        r"layout\.capacity of device 12 is 0; it should be a finite number from 0.001",
    ),
    "capacity of 1e-300": (LAYOUT.replace(capacity=np.full(12, 1e-300)), r"layout\.capacity of device 1 is 1e-300"),
    "capacity of 1e300": (LAYOUT.replace(capacity=np.full(12, 1e300)), r"layout\.capacity of device 1 is 1e\+300"),
    "negative power": (layout(standby_power=(2, -1.0)), r"layout\.standby_power of device 3 is -1"),
    "rate of 0": (
        layout(processing_rate=(2, 0.0)),
        r"layout\.processing_rate of device 3 is 0; it should be a number greater",
    ),
    "type": (
        layout(device_type=(1, 5)),
        r"layout\.device_type of device 2 is 5; it should be a whole number from -1 to 4",
    ),
    "numbers as masks": (
        LAYOUT.replace(has_power=jnp.ones(12)),
        r"layout\.has_power has the dtype float32; it should be bool",
    ),
    "another shape": (
        LAYOUT.replace(task=LAYOUT.task[:5]),
        r"layout\.task has shape \(5,\); it should be \(12,\), one per",
    ),
    "traffic": (
        LAYOUT.replace(traffic=um.Traffic(weight=jnp.full((2, 12), 0.5).at[1, 3].set(jnp.nan))),
        r"layout\.traffic\.weight of window 2, device 4 is nan; it should be a finite number from 0 to 1",
    ),
    "priority": (LAYOUT.replace(priority=-jnp.ones(12)), r"layout\.priority of device 1 is -1"),
    "UAV": (
        LAYOUT.replace(fleet=make_fleet(PARAMS, 2).replace(speed_m_s=jnp.array([5.0, -5.0]))),
        r"layout\.fleet\.speed_m_s of UAV 2 is -5",
    ),
    "depot": (
        LAYOUT.replace(depots=make_depots([ORIGIN]).replace(packs=jnp.array([-1.0]))),
        r"layout\.depots\.packs of depot 1 is -1; it should be a number of at least 0",
    ),
}


@pytest.mark.usefixtures("without_type_checks")
@pytest.mark.parametrize(("bad", "line"), LAYOUTS.values(), ids=LAYOUTS)
def test_layouts_that_cannot_be_are_refused(bad, line):
    for call in (um.make_scenario, lambda bad: um.rollouts(STAY, PARAMS, bad, KEY[None])):
        with refused(line):
            call(bad)


def test_a_layout_of_another_size_than_the_parameters_is_refused():
    with refused(r"^layout has 12 devices; it should have params\.n_devices = 5 of them$"):
        um.make_scenario(LAYOUT, um.Params(n_devices=5))


def test_padding_is_no_fault():
    params = um.Params(n_devices=15)
    um.make_scenario(pad_layout(LAYOUT, 15), params)
    um.initial_state(params, pad_layout(LAYOUT, 15))


def test_a_device_that_cannot_be_is_refused_when_a_layout_is_made():
    fields = [
        getattr(LAYOUT, name) for name in ("position", "device_type", "task", "capacity", "has_power", "has_comms")
    ]
    with refused(r"^capacity of device 1 is 0; it should be"):
        um.make_layout(*fields[:3], jnp.zeros(12), *fields[4:])
    with refused(r"^task of device 1 is 7; it should be a whole number from 0 to 4"):
        um.make_layout(*fields[:2], jnp.full(12, 7), *fields[3:])


@pytest.mark.parametrize("value", [jnp.nan, jnp.inf, -1.0])
def test_volumes_that_cannot_be_are_refused(value):
    with refused(r"^volumes of device 3 is .*; it should be a finite number from 0"):
        um.transition(PARAMS, LAYOUT, STATE, 0, VOLUMES.at[2].set(value))
    with refused(r"^volumes of entry 2, device 3 is"):
        check_volumes(np.array([VOLUMES, VOLUMES.at[2].set(value)]), 12)


@pytest.mark.parametrize("field", ["battery", "uav_energy"])
@pytest.mark.parametrize("value", [jnp.nan, jnp.inf, -1.0])
def test_energies_that_cannot_be_are_refused(field, value):
    state = STATE.replace(**{field: getattr(STATE, field).at[0].set(value)})
    what = {"battery": "device", "uav_energy": "UAV"}[field]
    for call in (
        lambda: um.transition(PARAMS, LAYOUT, state, 0, VOLUMES),
        lambda: rollout_from(STAY, PARAMS, LAYOUT, state, KEY),
    ):
        with refused(rf"^state\.{field} of {what} 1 is .*; it should be a finite number from 0"):
            call()


def test_numbers_of_slots_and_keys_that_cannot_be_are_refused():
    with refused("^slots is 0; it should be a whole number of at least 1$"):
        volume_table(PARAMS, 12, KEY, 0)
    with refused("^n_devices is -1; it should be a whole number from 1 to 1000$"):
        volume_table(PARAMS, -1, KEY, 3)
    with refused("^slots is -2; "):
        trace(STAY, PARAMS, LAYOUT, KEY, -2)
    with refused("^the number of keys is 0; "):
        um.rollouts(STAY, PARAMS, LAYOUT, jax.random.split(KEY, 0))


def test_a_reward_that_is_not_finite_is_refused():
    with refused("^per_slot is nan; it should be a finite number$"):
        make_reward("U", per_slot=float("nan"))
    reward = SCENARIO.reward.replace(weights=jnp.full(8, jnp.nan))
    for call in (
        lambda: um.make_scenario(LAYOUT, PARAMS, reward),
        lambda: returns(STAY, Scenario(PARAMS, LAYOUT, reward), KEY[None]),
    ):
        with refused(r"^reward\.weights of entry 1 is nan; it should be a finite number$"):
            call()


@pytest.mark.parametrize(
    ("value", "bounds", "line"),
    [
        (float("nan"), {"ge": 0}, "x is nan; it should be a finite number of at least 0"),
        (
            float("inf"),
            {"gt": 0, "le": 5, "infinite": True},
            "x is inf; it should be a number greater than 0 and at most 5",
        ),
        ([1.0, [2.0]], {}, r"x is \[1.0, \[2.0\]\]; it should be a finite number"),
        (1 + 2j, {}, r"x is \(1\+2j\); it should be a finite number"),
        ("3", {"lt": 4}, "x is '3'; it should be a finite number less than 4"),
        (None, {"whole": True}, "x is None; it should be a whole number"),
        (np.array([1e39]), {}, r"x of entry 1 is 1e\+39; it should be a finite number"),
        (2**31, {"ge": 0}, "x is 2147483648; it should be a finite number of at least 0, and a float"),
        (np.array([1, 3 * 10**9]), {}, "x of entry 2 is 3000000000; it should be a finite number, and a float"),
    ],
)
def test_a_number_out_of_range_is_named(value, bounds, line):
    with refused(line):
        check_range("x", value, **bounds)


def test_numbers_in_range_pass():
    check_range("x", np.zeros((0, 2)), gt=0)
    check_range("x", [1, 2.5], ge=1, lt=3)
    check_range("x", float("inf"), gt=0, infinite=True)
    check_range("x", [2**31 - 1, -(2**31)])
    check_range("x", 2**31, whole=True)
    assert not Bounds(gt=0, infinite=True).admits(float("nan"))
    check_bool("x", [True, False])


def test_compiled_programs_have_no_checks_outside_debug_checks():
    programs = (
        (SLOT, (PARAMS, LAYOUT, STATE, jnp.int32(0), VOLUMES)),
        (ENV.step, (KEY, STATE, jnp.int32(0), SCENARIO)),
        (lambda n: um.make_scenario(um.sample_layout(KEY, PARAMS, n, n)), (jnp.int32(3),)),
        (lambda params: um.rollout(STAY, params, LAYOUT, KEY), (PARAMS,)),
    )
    for program, arguments in programs:
        assert "callback" not in str(jax.make_jaxpr(program)(*arguments))
        with um.debug_checks():
            assert "callback" in str(jax.make_jaxpr(program)(*arguments))


def test_a_traced_action_is_clamped():
    clamped, last = (SLOT(PARAMS, LAYOUT, STATE, jnp.int32(place), VOLUMES) for place in (99, 11))
    assert all(map(np.array_equal, jax.tree.leaves(clamped), jax.tree.leaves(last)))


def test_debug_checks_find_a_bad_action_in_a_compiled_program():
    SLOT(PARAMS, LAYOUT, STATE, jnp.int32(99), VOLUMES)  # compiled without checks before
    with refused(f"^action is 99; {PLACES}$"), um.debug_checks():
        SLOT(PARAMS, LAYOUT, STATE, jnp.int32(99), VOLUMES)
    SLOT(PARAMS, LAYOUT, STATE, jnp.int32(99), VOLUMES)


def test_debug_checks_find_bad_volumes_and_energies_in_a_compiled_program():
    with refused("^volumes of device 1 is nan; "), um.debug_checks():
        SLOT(PARAMS, LAYOUT, STATE, jnp.int32(0), VOLUMES * jnp.nan)
    with refused(r"^state\.battery of device 1 is nan; "), um.debug_checks():
        SLOT(PARAMS, LAYOUT, STATE.replace(battery=STATE.battery * jnp.nan), jnp.int32(0), VOLUMES)


def test_debug_checks_find_a_bad_action_in_a_batch_at_once():
    with um.debug_checks(), refused(f"^action is 44; {PLACES}"):
        jax.vmap(ENV.step, (None, None, 0, None))(KEY, STATE, jnp.array([3, 44]), SCENARIO)


def test_debug_checks_find_a_bad_policy_and_bad_parameters():
    with refused(f"^action is 12; {PLACES}$"), um.debug_checks():
        um.rollout(lambda params, layout, state, key=None: jnp.int32(12), PARAMS, LAYOUT, KEY)
    with refused(r"^params\.uav_speed_m_s is -5; "), um.debug_checks():
        jax.jit(lambda speed: um.rollout(STAY, um.Params(uav_speed_m_s=speed), LAYOUT, KEY))(-5.0)
    with refused("^n_powered is 13; "), um.debug_checks():
        jax.vmap(lambda n: um.sample_layout(KEY, PARAMS, n, 8))(jnp.array([12, 13]))


def test_debug_checks_let_good_values_and_other_errors_pass():
    with um.debug_checks():
        um.rollouts(STAY, PARAMS, LAYOUT, jax.random.split(KEY, 2))
    with pytest.raises(KeyError, match="mine"), um.debug_checks():
        raise KeyError("mine")
