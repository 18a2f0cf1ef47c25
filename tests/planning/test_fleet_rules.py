"""Rules for fleets: their actions are legal, UAVs share the work, and dead devices are left alone."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tests.planning.fleets import mid_life, stack, town
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.fleet import make_depots, make_fleet
from uavmec_jax.env.params import Params
from uavmec_jax.planning import deadlines, heuristics
from uavmec_jax.planning.fleet_deadlines import earliest_deadline, split_among
from uavmec_jax.planning.heuristics import FLEET_HEURISTICS, HEURISTICS
from uavmec_jax.planning.shortest_tour import shortest_tour

NAMES = tuple(FLEET_HEURISTICS)
KEY = jax.random.key(0)
BY_INDEX = {"stay-put", "random", "round-robin"}
DEPOT = make_depots([[0.0, 0.0]])
TWO_DEPOTS = make_depots([[0.0, 0.0], [700.0, 400.0]], kind=["swap", "charge"], pads=[1, np.inf], packs=[3, np.inf])


def actions_of(params, layout, state, key):
    return {name: policy(params, layout, state, key) for name, policy in FLEET_HEURISTICS.items()}


act = jax.jit(jax.vmap(actions_of, (0, 0, 0, None)))


@cache
def batch(uavs, depots):
    """Return 8 scenarios of 10 entries, half with padding, half with UAVs that differ; ``depots=3``: one and padding."""
    at = {0: None, 1: DEPOT, 2: TWO_DEPOTS, 3: DEPOT}[depots]
    towns = [
        town(
            seed,
            uavs=uavs,
            flying=max(1, uavs - seed % 2),
            devices=10 - 3 * (seed % 2),
            padding=3 * (seed % 2),
            depots=at,
            more_depots=int(depots == 3),
            powered=seed % 5,
            connected=seed % 4,
            unequal=seed % 4 > 1,
        )
        for seed in range(8)
    ]
    # Padding has one form in a batch: a mask that may have no holes.
    towns = [
        (params, layout.replace(present=jnp.ones(10, bool) if layout.present is None else layout.present))
        for params, layout in towns
    ]
    return stack([params for params, _ in towns]), stack([layout for _, layout in towns]), towns


SLOW = [pytest.param(uavs, depots, marks=pytest.mark.slow) for uavs, depots in ((1, 0), (1, 2), (2, 0), (2, 1), (3, 3))]


@pytest.mark.parametrize(("uavs", "depots"), [(3, 2), *SLOW])
def test_actions_are_places_and_not_padding(uavs, depots):
    params, layouts, towns = batch(uavs, depots)
    for moment in (0, 1):
        states = stack([mid_life(seed + 100 * moment, *towns[seed]) for seed in range(8)])
        actions = act(params, layouts, states, KEY)
        again = act(params, layouts, states, KEY)
        real = np.asarray(layouts.present)
        if layouts.depots is not None:
            real = np.concatenate([real, np.asarray(layouts.depots.pads) >= 1], axis=1)
        for name in NAMES:
            action = np.asarray(actions[name])
            assert action.shape == ((8,) if uavs == 1 else (8, uavs)), name
            assert action.dtype == np.int32, name
            assert_array_equal(action, again[name], err_msg=name)
            assert np.take_along_axis(real, action.reshape(8, -1), axis=1).all(), name


def test_alone_a_rule_for_fleets_is_the_rule_for_one_uav():
    params, layouts, towns = batch(1, 0)
    states = stack([mid_life(seed, *towns[seed]) for seed in range(8)])
    actions = act(params, layouts, states, KEY)
    rules = {
        "stay-put": heuristics.stay_put,
        "random": heuristics.random,
        "round-robin": heuristics.round_robin,
        "oldest-first": heuristics.oldest_first,
        "lowest-battery": heuristics.lowest_battery,
        "shortest-life": heuristics.shortest_life,
        "shortest-tour": shortest_tour,
        "earliest-deadline": deadlines.earliest_deadline,
        "split-deadline": deadlines.earliest_deadline,
    }
    assert set(rules) == set(NAMES)

    def ask_all(params, layout, state):
        own = {
            f"uav_{name}": getattr(layout.fleet, name)[0]
            for name in ("speed_m_s", "flying_power_w", "hovering_power_w", "battery_j", "signal_range_m")
        }
        return {name: rule(params.replace(**own), layout, state, KEY) for name, rule in rules.items()}

    for name, action in jax.jit(jax.vmap(ask_all))(params, layouts, states).items():
        assert_array_equal(actions[name], action, err_msg=name)


def test_uavs_choose_different_devices():
    params, layouts, towns = batch(3, 3)
    states = stack([initial_state(*one).replace(age=jnp.full(10, 8, jnp.int32)) for one in towns])
    batteries = jnp.asarray(layouts.capacity) * jnp.linspace(0.3, 0.5, 10)
    states = states.replace(battery=jnp.where(layouts.present, batteries, layouts.capacity))
    actions = act(params, layouts, states, KEY)
    for name in set(NAMES) - {"random"}:
        for action, fleet in zip(np.asarray(actions[name]), np.asarray(layouts.fleet.present), strict=True):
            assert len(set(action[fleet])) == fleet.sum(), name


def test_renumbering_devices_renumbers_the_actions():
    """Regions are so wide that no two devices are served together: hover points have no ties."""
    towns = [
        town(seed, uavs=3, flying=3, devices=10, depots=TWO_DEPOTS, powered=3, connected=2, region_m=(6000.0, 6000.0))
        for seed in range(8)
    ]
    towns = [(params, layout.replace(present=jnp.ones(10, bool))) for params, layout in towns]
    states = [mid_life(seed, *towns[seed]) for seed in range(8)]
    # Ties go to the lowest number, so there are none: devices with communication are older than any data can be.
    ages = [np.random.default_rng(seed).permutation(10) for seed in range(8)]
    states = [state.replace(age=jnp.asarray(age, jnp.int32)) for state, age in zip(states, ages, strict=True)]
    orders = [np.random.default_rng(50 + seed).permutation(10) for seed in range(8)]
    per_device = ("position", "device_type", "task", "capacity", "has_power", "has_comms")
    per_device += ("standby_power", "active_power", "processing_rate", "present")

    def renumber(tree, names, order):
        return tree.replace(**{name: jnp.asarray(getattr(tree, name))[order] for name in names})

    params, layouts = stack([one[0] for one in towns]), stack([one[1] for one in towns])
    renumbered = stack([renumber(one[1], per_device, order) for one, order in zip(towns, orders, strict=True)])
    later = stack(
        [renumber(state, ("battery", "age", "failed_at"), order) for state, order in zip(states, orders, strict=True)]
    )
    before, after = act(params, layouts, stack(states), KEY), act(params, renumbered, later, KEY)
    for name in set(NAMES) - BY_INDEX - {"shortest-tour"}:
        old_number = np.stack([np.append(order, [10, 11]) for order in orders])
        assert_array_equal(np.take_along_axis(old_number, np.asarray(after[name]), axis=1), before[name], err_msg=name)


@pytest.mark.slow
def test_a_large_fleet_serves_many_devices():
    params, layout = town(0, uavs=20, devices=40, depots=DEPOT, powered=10, connected=10, unequal=True)
    state = mid_life(0, params, layout)
    actions = jax.jit(actions_of)(params, layout, state, KEY)
    flying = ~np.asarray(state.grounded)
    for name in NAMES:
        action = np.asarray(actions[name])
        assert action.shape == (20,), name
        assert np.isin(action, np.arange(41)).all(), name
        devices = action[flying & (action < 40)]
        if name != "random":
            assert len(set(devices)) >= 0.9 * len(devices), name


def test_a_state_that_leaves_fields_out_is_completed():
    params, layout = town(0, uavs=2, depots=DEPOT)
    state = initial_state(params, layout)
    short = state.replace(grounded=None, failed_at=None, packs=None)
    decide = jax.jit(HEURISTICS["oldest-first"])
    assert_array_equal(decide(params, layout, short), decide(params, layout, state))


class TestDeadDevices:
    """Where episodes go on after a failure, devices that are out for good are nobody's business."""

    @pytest.mark.slow
    @pytest.mark.parametrize("uavs", [1, 2])
    def test_they_are_not_visited(self, uavs):
        params, layout = town(3, uavs=uavs, devices=8, powered=2, connected=2, end="horizon")
        layout = layout.replace(present=jnp.ones(8, bool))
        states = []
        for seed in range(8):
            state = mid_life(seed, params, layout)
            dead = np.random.default_rng(seed).random(8) < 0.4
            dead[seed] = False
            states.append(
                state.replace(
                    battery=jnp.where(dead, 0.0, state.battery),
                    age=jnp.where(dead, 40, state.age),
                    failed_at=jnp.where(dead, 5, -1).astype(jnp.int32),
                )
            )
        states = stack(states)
        actions = jax.jit(jax.vmap(actions_of, (None, None, 0, None)))(params, layout, states, KEY)
        alive = np.asarray(states.failed_at) < 0
        for name in NAMES:
            assert np.take_along_axis(alive, np.asarray(actions[name]).reshape(8, -1), axis=1).all(), name

    def test_expired_data_are_collected(self):
        """How long ago data expired makes no difference to the earliest deadline; the nearest device is visited."""
        params, layout = town(0, uavs=2, devices=8, powered=8, connected=0, end="horizon")
        state = initial_state(params, layout).replace(age=jnp.array([60, 50, 40, 30, 20, 12, 11, 3], jnp.int32))
        action = np.asarray(jax.jit(earliest_deadline)(params, layout, state))
        nearest = np.argsort(np.linalg.norm(layout.position, axis=1)[:7])
        assert action[0] == nearest[0]


class TestSplit:
    """The static split of the devices among the UAVs that fly."""

    def split(self, seed, flies, devices=12, **changes):
        params, layout = town(seed, uavs=len(flies), devices=devices, **changes)
        owner = jax.jit(split_among)(params, layout, jnp.array(flies))
        return layout, np.asarray(owner)

    def test_shares_are_equal_where_devices_are(self):
        """Data alone: each hover point needs as many visits as any other."""
        for seed in range(6):
            _, owner = self.split(seed, [True] * 3, powered=12, connected=0, uav_signal_range_m=1.0)
            assert sorted(np.bincount(owner, minlength=3)) == [4, 4, 4]

    def test_every_uav_has_something_to_do(self):
        for seed in range(6):
            owner = self.split(seed, [True] * 3, powered=0, connected=0)[1]
            assert set(owner) == {0, 1, 2}

    def test_grounded_uavs_own_nothing(self):
        for seed in range(3):
            _, owner = self.split(seed, [False, True, True])
            assert set(owner) == {1, 2}

    def test_more_uavs_than_devices(self):
        _, owner = self.split(0, [True] * 9, devices=4, powered=4, connected=0, uav_signal_range_m=1.0)
        assert len(set(owner)) == 4

    def test_devices_that_share_a_hover_point_stay_together(self):
        params, layout = town(0, uavs=3, devices=12, powered=0, connected=0)
        # Four clusters of three, each within range of its middle device.
        middles = np.repeat([[100.0, 100.0], [700.0, 100.0], [100.0, 700.0], [700.0, 700.0]], 3, axis=0)
        layout = layout.replace(
            position=jnp.asarray(middles + np.tile([[-50, 0], [0, 0], [50, 0]], (4, 1)), jnp.float32)
        )
        owner = np.asarray(jax.jit(split_among)(params, layout, jnp.ones(3, bool)))
        assert (owner.reshape(4, 3) == owner.reshape(4, 3)[:, :1]).all()
        assert set(owner) == {0, 1, 2}

    def test_neighbours_belong_together(self):
        """Groups are sectors: the mean distance to one's own group is far below that to the others."""
        layout, owner = self.split(4, [True] * 3, powered=0, connected=0)
        position = np.asarray(layout.position)
        distance = np.linalg.norm(position[:, None] - position, axis=-1)
        same = owner[:, None] == owner
        assert distance[same & (distance > 0)].mean() < distance[~same].mean()


def test_a_single_uav_of_its_own_kind_follows_its_own_values():
    """With one UAV and no depots the rule reckons with the values of the fleet, not with those of the parameters."""
    params, layout = town(1, uavs=1, devices=8, powered=4, connected=4)
    weak = layout.replace(fleet=make_fleet(Params(), 1, battery_j=0.2e6))
    same = params.replace(uav_battery_j=np.float32(0.2e6))
    states = stack([mid_life(seed, params, weak) for seed in range(8)])
    act_alone = jax.jit(jax.vmap(HEURISTICS["earliest-deadline"], (None, None, 0)))
    assert_array_equal(act_alone(params, weak, states), act_alone(same, weak.replace(fleet=None), states))
