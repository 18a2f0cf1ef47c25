"""What fuzzing found (experiments/fuzz.py), one test each; classes of input have theirs in the rooms."""

import json
import math
import sqlite3
import struct
from contextlib import closing
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import uavmec_jax as um
from tests.scenarios.test_state_files import CAPACITY, state_of
from tests.search.test_folder import begun, refusal  # noqa: F401  (a fixture)
from tests.search.test_search import space  # noqa: F401  (a fixture)
from uavmec_jax.cluster.options import RayOptions
from uavmec_jax.env import hardware
from uavmec_jax.env.generator import ScenarioDistribution, sample_scenario
from uavmec_jax.env.padding import pad_layout
from uavmec_jax.errors import ArgumentError, PolicyError, StateError, StudyError
from uavmec_jax.files.archives import read_checked, write_checked
from uavmec_jax.planning.plan import make_plan
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.run_plan import plan_run
from uavmec_jax.runs.simulate import simulate
from uavmec_jax.scenarios.named_scenario import name_scenario
from uavmec_jax.scenarios.places import on_place
from uavmec_jax.scenarios.scenario_files import scenario_text
from uavmec_jax.scenarios.seeds import held_out_draws, layout_for_seed
from uavmec_jax.search.folder import DATABASE, FACTS
from uavmec_jax.studies.policy_evaluation import evaluate_policy
from uavmec_jax.training.chunks import Validation

PARAMS = um.Params()
LAYOUT = um.sample_layout(jax.random.key(0), PARAMS, 8, 8)
STATE = um.initial_state(PARAMS, LAYOUT)
VOLUMES = jnp.full(12, 3e6)
DISTRIBUTION = ScenarioDistribution(PARAMS.replace(n_devices=16), um.make_reward())
KEY = jax.random.key(0)
OLDEST_FIRST = um.planning.HEURISTICS["oldest-first"]
SCENARIO = um.make_scenario(LAYOUT, PARAMS)
INFINITE = SCENARIO.reward.replace(traffic_bonus=jnp.float32(jnp.inf))
NAMED = name_scenario(LAYOUT, PARAMS, "x")


def test_names_in_a_database_that_are_not_utf8(space, begun):  # noqa: F811
    """sqlite3 raised OperationalError where it made text of them."""
    with closing(sqlite3.connect(begun / DATABASE)) as connection, connection:
        connection.execute("UPDATE studies SET study_name = CAST(X'FF00' AS TEXT)")
    assert "trials.db: cannot be used: Could not decode to UTF-8 column" in refusal(space, begun)


def test_a_schema_in_a_database_that_is_not_utf8(space, begun):  # noqa: F811
    """SQLite quotes it in its message, and sqlite3 raised UnicodeDecodeError where it read that."""
    with closing(sqlite3.connect(begun / DATABASE)) as connection, connection:
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute(
            "UPDATE sqlite_master SET name = CAST(X'C328' AS TEXT), sql = 'CREATE x' WHERE name = 'trials'"
        )
    assert "trials.db: cannot be used: its schema is damaged" in refusal(space, begun)


def test_a_search_with_a_bad_database_writes_nothing(space, begun):  # noqa: F811
    """The label was written before the database was opened."""
    facts = (begun / FACTS).read_text()
    (begun / DATABASE).write_bytes(b"SQLite no more" * 1000)
    (begun / FACTS).write_text(json.dumps(json.loads(facts), indent=7))
    before = (begun / FACTS).read_bytes()
    assert "trials.db: cannot be used" in refusal(space, begun)
    assert (begun / FACTS).read_bytes() == before


def test_an_offset_in_front_of_an_archives_beginning_is_damage(tmp_path):
    """It is an OSError, EINVAL, and was taken for a fault of the disk."""
    path = tmp_path / "x.npz"
    write_checked(path, 1, {}, {"a": np.arange(3)})
    content = bytearray(path.read_bytes())
    end = content.rindex(b"PK\x05\x06")
    content[end + 12 : end + 20] = struct.pack("<II", len(content), 2**32 - 2)
    path.write_bytes(content)
    with pytest.raises(StudyError, match=r"x\.npz: ") as refused:
        read_checked(path, 1, "a test", StudyError)
    assert not isinstance(refused.value.__cause__, OSError)


def test_a_battery_that_is_0_in_single_precision():
    with pytest.raises(StateError, match=r"battery_j is 9.99989e-321; give more than 0"):
        state_of({"battery_j": [1e-320, *CAPACITY[1:]]})


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: RayOptions("local", cpus_per_shard=0), "cpus_per_shard"),
        (lambda: RayOptions("local", retries=10**30), "retries"),
        (lambda: RayOptions("local", time_limit_s=float("nan")), "time_limit_s"),
        (lambda: trained(Validation(draws=0)), r"validation\.draws"),
        (lambda: trained(Validation(every=-4)), r"validation\.every"),
        (lambda: pad_layout(LAYOUT, 10**9), "size"),
        (lambda: layout_for_seed(2**40, PARAMS, 8, 8), "seed"),
        (lambda: held_out_draws(0, 8, 8, 10**9), "draws"),
        (lambda: sample_scenario(bad_distribution(), jax.random.key(0)), r"distribution\.traffic_weights"),
    ],
)
def test_numbers_without_bounds(call, name):
    """What raised something else, allocated gigabytes or computed nonsense is one line that names the argument."""
    with pytest.raises(ArgumentError, match=f"^{name} "):
        call()


def trained(validation):
    scenarios = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], um.make_scenario(LAYOUT))
    return um.train("ppo", scenarios, key=jax.random.key(0), steps=1, validation=validation)


def bad_distribution():
    return ScenarioDistribution(
        params=PARAMS, reward=um.make_reward({"log A": 1.0}), traffic_weights=jnp.array([jnp.nan, 1.0])
    )


@pytest.mark.usefixtures("without_type_checks")
@pytest.mark.parametrize(
    "call",
    [
        lambda: um.sample_layout(jax.random.key(0), um.Params(device_battery_range_j=1e5), 0, 0),
        lambda: RunOptions(checkpoint_every_s="60"),
        lambda: RunOptions(checkpoint_share=1j),
        lambda: um.env.make_depots(np.zeros((1, 2), complex)),
        lambda: um.transition(PARAMS.replace(bandwidth_hz=2**63), LAYOUT, STATE, 0, VOLUMES),
        lambda: um.transition(PARAMS.replace(uav_altitude_m=2**31 - 1), LAYOUT, STATE, 0, VOLUMES),
        lambda: um.transition(PARAMS, LAYOUT, STATE.replace(slot=2**63), 0, VOLUMES),
        lambda: um.transition(PARAMS, LAYOUT, STATE, [[1], [2, 3]], VOLUMES),
        lambda: on_place(LAYOUT, um.traffic.load_evacuation("albany"), moving=float("nan")),
        lambda: scenario_text(replace(NAMED, params=PARAMS.replace(region_m=(800.0, -math.inf)))),
        lambda: um.make_reward({"U": 1e300}),
        lambda: um.make_reward({"U": [1.0, 2.0]}),
        lambda: um.make_reward({"S": "1"}),
        lambda: pad_layout(LAYOUT, 11),
        lambda: um.planning.beam_search(PARAMS, LAYOUT, jnp.ones((33, 12)), width=2**31),
        lambda: um.planning.upper_bound(PARAMS.replace(uav_battery_j=2**31), LAYOUT, jnp.ones((33, 12)), 1),
        lambda: um.initial_state(PARAMS.replace(uav_battery_j=np.int64(2**31)), LAYOUT),
        lambda: um.initial_state(PARAMS.replace(count_unfinished_slot=1e300), LAYOUT),
        lambda: um.env.rollout_from(OLDEST_FIRST, PARAMS, LAYOUT, STATE.replace(failed_at=jnp.full(12, jnp.nan)), KEY),
        lambda: um.env.rollout_from(OLDEST_FIRST, PARAMS, LAYOUT, STATE.replace(packs=jnp.ones(3)), KEY),
        lambda: um.env.rollout_from(OLDEST_FIRST, PARAMS, LAYOUT, STATE.replace(grounded=jnp.ones(1)), KEY),
        lambda: um.rollouts("round-robin", PARAMS, LAYOUT, KEY[None]),
        lambda: um.make_reward(3),
        lambda: um.make_reward("u"),
        lambda: um.initial_state(PARAMS.replace(region_m=800), LAYOUT),
        lambda: um.planning.upper_bound(PARAMS, LAYOUT, jnp.ones(12)),
        lambda: um.planning.upper_bound(PARAMS, LAYOUT, jnp.ones((0, 12))),
        lambda: um.planning.beam_search(PARAMS, LAYOUT, jnp.ones((0, 12))),
        lambda: OLDEST_FIRST(PARAMS, LAYOUT.replace(capacity=jnp.full(12, jnp.nan)), STATE),
        lambda: um.load_policy("generalist")(PARAMS, LAYOUT, STATE.replace(battery=jnp.full(12, jnp.nan))),
        lambda: um.env.rollout_draws(OLDEST_FIRST, SCENARIO.replace(reward=INFINITE), KEY[None]),
        lambda: scenario_text(replace(NAMED, state=STATE.replace(elapsed=jnp.inf))),
        lambda: pad_layout(LAYOUT.replace(task=np.full(12, 1e300)), 13),
        lambda: sample_scenario(replace(DISTRIBUTION, uav_factor=(1e-320, 1.0)), jax.random.key(0)),
        lambda: sample_scenario(replace(DISTRIBUTION, devices=(4, 0)), jax.random.key(0)),
        lambda: name_scenario(LAYOUT.replace(task=jnp.full(12, 99)), PARAMS, "x"),
        lambda: name_scenario(LAYOUT.replace(device_type=jnp.zeros(12)), PARAMS, "x"),
        lambda: name_scenario(LAYOUT, PARAMS, "x", ["a", "b"]),
        lambda: um.planning.observe_devices(PARAMS, LAYOUT, STATE.replace(uav_energy=jnp.ones(1, complex))),
        lambda: evaluate_policy(OLDEST_FIRST, 1j, NAMED, KEY[None]),
    ],
)
def test_values_of_another_kind(call):
    """These raised TypeError or OverflowError, or were taken as they were."""
    with pytest.raises(ArgumentError) as refused:
        call()
    assert "\n" not in str(refused.value)


def test_a_path_that_is_too_long():
    """Looking for it raised OSError."""
    with pytest.raises(StudyError, match=r"^A{60}\.\.\.: File name too long; give a shorter path$"):
        um.load_results("A" * 300)


def test_a_scenario_that_is_named_keeps_its_hardware():
    """Those of a distribution had the powers and rates of the tables, and unlisted devices those of the last row."""
    drawn = sample_scenario(replace(DISTRIBUTION, typical=0.0), jax.random.key(1))
    named = name_scenario(drawn.layout, drawn.params, "x")
    assert 4 <= named.layout.n_devices == drawn.layout.present.sum() < 16
    unlisted = name_scenario(LAYOUT.replace(device_type=jnp.full(12, hardware.UNLISTED)), PARAMS, "x")
    for field in ("standby_power", "active_power", "processing_rate"):
        present = getattr(drawn.layout, field)[: named.layout.n_devices]
        assert np.array_equal(getattr(named.layout, field), present)
        assert np.array_equal(getattr(unlisted.layout, field), getattr(LAYOUT, field))


@pytest.mark.usefixtures("without_type_checks")
def test_volumes_of_numpy_are_searched():
    """A traced slot is no index of NumPy's."""
    volumes = um.env.volume_table(PARAMS, 12, jax.random.key(0), 33)
    of_jax, of_numpy = (
        um.planning.beam_search(PARAMS, LAYOUT, array, width=2).lifetime for array in (volumes, np.asarray(volumes))
    )
    assert of_jax == of_numpy


def test_a_layout_of_numpy_arrays_is_played():
    """A traced action is no index of NumPy's."""
    layouts = LAYOUT, jax.tree.map(np.asarray, LAYOUT)
    policy = um.planning.HEURISTICS["oldest-first"]
    of_jax, of_numpy = (um.rollout(policy, PARAMS, layout, jax.random.key(0)).length for layout in layouts)
    assert of_jax == of_numpy


def test_an_observation_of_complex_numbers():
    policy = um.load_policy("generalist")
    with pytest.raises(PolicyError, match="the observation is not an array of numbers"):
        policy.act(np.zeros((12, 9), complex))


@pytest.mark.parametrize(("devices", "speed"), [(-1, 100.0), (10**9, 100.0), (10, float("inf")), (10, 0.0)])
def test_a_simulation_of_no_machine(devices, speed):
    study = um.load_study("table5")
    with pytest.raises(ArgumentError, match=r"^(devices|speed) is "):
        simulate(study, plan_run(study), speed=speed, devices=devices)


@pytest.mark.slow
def test_a_plan_of_a_layout_of_numpy_arrays():
    """Changes were made with JAX's ``.at``, which NumPy's arrays do not have."""
    draws = jax.random.key(0)[None]
    of_jax, of_numpy = (
        make_plan(PARAMS, layout, draws, width=2) for layout in (LAYOUT, jax.tree.map(np.asarray, LAYOUT))
    )
    assert of_numpy.what_if == of_jax.what_if
    assert len(of_numpy.what_if) > 0
