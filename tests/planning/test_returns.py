"""Returns to depots: nobody is stranded, not all are away at once, pads and packs go round."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.planning.fleets import mid_life, stack, town
from uavmec_jax.env.depots import can_help
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.fleet import make_depots
from uavmec_jax.env.rollout import trace_from
from uavmec_jax.planning.heuristics import FLEET_HEURISTICS

CORNER = (0.0, 0.0)
FULL = 1_600_000.0
SLOTS = 64
EASY = {"powered": 8, "data_age_limit_slots": 250}  # nothing fails, but oldest-first keeps all UAVs busy


@cache
def player(name):
    """Return the function that plays 64 slots under a heuristic, for a batch of scenarios."""

    def play(params, layout, state, key):
        return trace_from(FLEET_HEURISTICS[name], params, layout, state, key, SLOTS)

    return jax.jit(jax.vmap(play))


def play(name, towns, states=None):
    """Play a batch of scenarios; return for each the actions ``[slots, K]`` and the states, the first one included."""
    states = [initial_state(*one) for one in towns] if states is None else states
    keys = jax.random.split(jax.random.key(1), len(towns))
    slots = player(name)(stack([one[0] for one in towns]), stack([one[1] for one in towns]), stack(states), keys)
    played = np.asarray(slots.played).sum(axis=1)
    episodes = []
    for number, count in enumerate(played):
        history = jax.tree.map(
            lambda start, later, number=number, count=count: np.concatenate(
                [np.asarray(start)[None], np.asarray(later)[number, :count]]
            ),
            states[number],
            slots.state,
        )
        episodes.append((np.asarray(slots.action)[number, :count], history))
    return episodes


def depots(kind="swap", **values):
    """Return a depot in the corner and one on the other side, of any kind."""
    return make_depots([CORNER, (760.0, 700.0)], kind=kind, **values)


def fleet(seed, flying, devices=8, **values):
    """Return a town with 4 UAVs and 8 devices, less those that are padding: one shape, one compilation."""
    params, layout = town(seed, uavs=4, flying=flying, devices=devices, padding=8 - devices, **values)
    return params, layout.replace(present=jnp.arange(8) < devices)


def reaches(layout, history):
    """Return which UAVs can reach a depot that helps before each slot, ``[slots, K]``."""
    at = np.asarray(layout.depots.position)
    distance = np.linalg.norm(history.uav_position[:, :, None] - at, axis=-1)
    power = np.asarray(layout.fleet.flying_power_w / layout.fleet.speed_m_s)[:, None]
    helps = np.asarray(can_help(layout.depots, jnp.asarray(history.packs)))[:, None]
    return np.any(helps & (history.uav_energy[..., None] >= 1.0001 * power * distance), axis=-1) & ~history.grounded


@pytest.mark.parametrize("name", [pytest.param("earliest-deadline", marks=pytest.mark.slow), "oldest-first"])
def test_who_can_reach_a_depot_is_never_grounded(name):
    """From anywhere in an episode, with UAVs that differ, few pads and packs, slow UAVs and slow links."""
    towns, states = [], []
    for seed in range(32):
        limits = {"pads": [1, 2], "packs": [3, 5]} if seed % 4 == 0 else {}
        changes = [{}, {"uav_speed_m_s": 1.0}, {"uplink_rate_bit_s": 20.0}, {"flight_power_adds_to_hover": True}][
            seed % 4
        ]
        kind = [["swap", "charge"], "charge", "swap"][seed % 3]
        one = fleet(
            seed, 1 + seed % 4, depots=depots(kind, **limits), powered=seed % 9, unequal=seed % 2 > 0, **changes
        )
        towns.append(one)
        states.append(mid_life(seed, *one) if seed % 8 else initial_state(*one))
    for (_, layout), (_, history) in zip(towns, play(name, towns, states), strict=True):
        could = reaches(layout, history)[:-1]
        assert not (could & history.grounded[1:]).any()


@pytest.mark.parametrize("name", ["earliest-deadline", "oldest-first"])
@pytest.mark.parametrize("kind", ["swap", "charge"])
def test_nobody_ends_grounded_where_depots_always_help(name, kind):
    towns = [fleet(seed, 1 + seed % 4, depots=depots(kind), **(EASY if seed < 16 else {})) for seed in range(32)]
    for (_, layout), (actions, history) in zip(towns, play(name, towns), strict=True):
        uavs = np.asarray(layout.fleet.present)
        assert not history.grounded[:, uavs].any()
        if len(actions) == SLOTS:  # longer than a battery lasts
            assert ((actions[:, uavs] >= 8).any(axis=0)).all()


@pytest.mark.parametrize("kind", ["swap", "charge"])
def test_not_all_uavs_are_at_depots_at_once(kind):
    """UAVs that start with equal energies return one after the other, although all are needed all the time."""
    towns = [fleet(seed, 2 + seed % 3, depots=depots(kind), **EASY) for seed in range(32)]
    for (_, layout), (actions, _) in zip(towns, play("oldest-first", towns), strict=True):
        away = actions[:, np.asarray(layout.fleet.present)] >= 8
        assert len(actions) == SLOTS
        assert away.any(axis=0).all()
        assert not away.all(axis=1).any()


def test_data_do_not_expire_while_a_uav_is_away():
    """Two UAVs for eight devices without communication: enough as long as one of them at a time is at a depot."""
    towns = [fleet(seed, 2, depots=depots(["swap", "charge"][seed % 2]), powered=8, connected=0) for seed in range(32)]
    for actions, _ in play("earliest-deadline", towns):
        assert len(actions) == SLOTS


def test_charging_ends_at_four_fifths():
    towns = [fleet(seed, 1 + seed % 3, depots=depots("charge"), **EASY) for seed in range(32)]
    for (_, layout), (actions, history) in zip(towns, play("oldest-first", towns), strict=True):
        charging = (actions >= 8) & np.asarray(layout.fleet.present)
        assert (history.uav_energy[:-1][charging] < 0.8 * FULL).all()
        leaves = charging[:-1] & ~charging[1:]
        assert (history.uav_energy[1:-1][leaves] >= 0.8 * FULL).all()


def test_a_pad_is_for_one_uav_at_a_time():
    towns = [fleet(seed, 4, depots=depots("charge", pads=1), **EASY) for seed in range(32)]
    for actions, _ in play("oldest-first", towns):
        at_each = (actions[..., None] == [8, 9]).sum(axis=1)
        assert at_each.max() == 1


def test_packs_are_not_fetched_twice_and_where_none_are_left_nobody_goes():
    towns = [fleet(seed, 3, depots=depots(packs=[1, 2]), **EASY) for seed in range(32)]
    for _, (actions, history) in zip(towns, play("oldest-first", towns), strict=True):
        fetched = (actions[..., None] == [8, 9]).sum(axis=1)
        assert (fetched <= np.maximum(history.packs[:-1], 0)).all()
        assert (history.packs[-1] == 0).all()
        assert fetched.sum() == 3  # no visit in vain


def test_a_depot_that_cannot_help_is_left_alone():
    """Of two depots in one place, only the first one counts; one without power and one without packs never do."""
    useless = make_depots([CORNER, CORNER], ["swap", "charge"], packs=[0, 0], power_w=[667.0, 667.0])
    towns = [fleet(seed, 2, depots=useless, **EASY) for seed in range(32)]
    for actions, _ in play("oldest-first", towns):
        assert (actions < 8).all()


def test_who_cannot_return_goes_on():
    """A UAV whose energy reaches no depot serves as long as it can."""
    towns = [fleet(seed, 1, depots=depots(), **EASY) for seed in range(32)]
    far = [
        initial_state(*one).replace(
            uav_energy=jnp.full(4, 1e5, jnp.float32), uav_position=jnp.full((4, 2), 2e4, jnp.float32)
        )
        for one in towns
    ]
    near = [one[1].replace(position=one[1].position + jnp.float32(2e4)) for one in towns]
    towns = [(params, layout) for (params, _), layout in zip(towns, near, strict=True)]
    for actions, history in play("oldest-first", towns, far):
        assert (actions[:, 0] < 8).all()
        assert history.slot[-1] >= 1


def test_padding_is_no_reason_to_return():
    """Entries that are padding are far away; the way back from there is nobody's concern."""
    towns = [fleet(seed, 2, devices=6, depots=depots(), powered=6, data_age_limit_slots=250) for seed in range(32)]
    for actions, _ in play("oldest-first", towns):
        assert np.isin((actions >= 8).sum(axis=0)[:2], [1, 2, 3]).all()  # a battery lasts for 20 to 33 slots
