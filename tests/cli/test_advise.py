"""`uavmec advise`, and the policy that ships with the package."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_array_equal

import uavmec_jax as um
from tests.scenarios.test_scenario_files import EXAMPLES
from uavmec_jax.cli import main
from uavmec_jax.env.rollout import rollout_from
from uavmec_jax.scenarios.policies import load_policy
from uavmec_jax.scenarios.state_files import state_data

HARBOUR = EXAMPLES / "harbour.toml"


def advise(*arguments):
    return CliRunner().invoke(main, ["advise", *map(str, arguments)], catch_exceptions=False)


@pytest.fixture(scope="module")
def generalist():
    return load_policy("generalist")


@pytest.fixture(scope="module")
def advice():
    done = advise(HARBOUR, "--samples", 32, "--json")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def test_json_has_the_advice(advice):
    names = um.scenarios.load_scenario_file(HARBOUR).device_names
    assert advice["next"]["name"] in names
    assert advice["ranking"][0]["name"] == advice["next"]["name"]
    assert sorted(candidate["name"] for candidate in advice["ranking"]) == sorted(names)
    assert set(advice["first_failure"]) == set(names)
    assert abs(sum(advice["first_failure"].values()) + advice["no_device_fails"] - 1) < 1e-3
    low, high = advice["lifetime"]["interval"]
    assert low <= advice["lifetime"]["mean"] <= high
    assert advice["lifetime"]["futures"] == 32
    assert advice["what_if"][0]["gain"] >= advice["what_if"][-1]["gain"]
    assert advice["warnings"] == []


@pytest.mark.slow
def test_one_visit_after_the_other(tmp_path, advice):
    """The state after a visit is read back and advised on."""
    scenario = um.scenarios.load_scenario_file(HARBOUR)
    state = um.initial_state(scenario.params, scenario.layout)
    volumes = jnp.full(6, 3e6)
    after, outcome = um.transition(scenario.params, scenario.layout, state, advice["next"]["device"] - 1, volumes)
    assert int(outcome.cause) == um.Cause.NONE
    (tmp_path / "now.json").write_text(json.dumps(state_data(replace(scenario, state=after))))
    done = advise(HARBOUR, "--state", tmp_path / "now.json", "--samples", 32, "--json", "--no-what-if")
    again = json.loads(done.stdout)
    assert again["state"]["slot"] == 1
    assert again["what_if"] == []
    assert again["lifetime"]["interval"][0] > 1


@pytest.mark.slow
def test_tables(generalist):
    done = advise(HARBOUR, "--samples", 16)
    assert done.exit_code == 0
    for words in ("Visit next", "First to fail", "What a repair or a removal would bring now", "Next: #"):
        assert words in done.stdout


@pytest.mark.slow
def test_a_scenario_out_of_distribution_is_advised_on_with_a_warning(tmp_path):
    text = HARBOUR.read_text().replace("capacity_j = 7", "capacity_j = 97", 1)
    (tmp_path / "big.toml").write_text(text)
    done = advise(tmp_path / "big.toml", "--samples", 8, "--no-what-if", "--json")
    assert done.exit_code == 0
    (line,) = done.stderr.splitlines()
    assert line.startswith("uavmec: warning: ")
    assert "battery capacities in J" in line
    assert "it was trained on 25,000 to 160,000" in line
    assert len(json.loads(done.stdout)["warnings"]) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--samples", 1), "--samples is 1; give a whole number from 2 to 100000"),
        (("--policy", "generalst"), "did you mean 'generalist'?"),
        (("--price", 3), "price is given, but the traffic of these devices is unknown"),
        (("--powered", 3), "leave out --powered"),
        (("--uavs", 2), "a scenario file says which UAVs and depots there are; leave out --uavs, --depot"),
        (("--depot", "swap"), "leave out --uavs, --depot"),
        (("--state", "nowhere.json"), "nowhere.json"),
    ],
)
def test_bad_input_is_one_line(arguments, words):
    done = advise(HARBOUR, *arguments)
    assert done.exit_code == 2
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_traffic_has_a_price():
    done = advise("--place", "albany", "--price", 10, "--samples", 8, "--no-what-if", "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["next"]["name"]


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 12, 30])
def test_the_shipped_policy_takes_any_number_of_devices(generalist, n):
    params = um.Params(n_devices=n)
    layout = um.sample_layout(jax.random.key(n), params, n // 2, n // 2)
    state = um.initial_state(params, layout)
    action = generalist(params, layout, state)
    assert action.shape == ()
    assert 0 <= int(action) < n
    assert int(jax.jit(generalist)(params, layout, state)) == int(action)
    states = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    assert_array_equal(generalist(params, layout, states), [action, action])
    assert generalist.value(params, layout, states).shape == (2,)


@pytest.mark.slow
def test_the_shipped_policy_acts_on_raw_observations(generalist):
    params, layout = um.Params(), um.sample_layout(jax.random.key(1), um.Params(), 8, 8)
    state = um.initial_state(params, layout)
    features = um.planning.observe_devices(params, layout, state).features
    observation = np.concatenate([features, np.ones((12, 1), np.float32)], axis=1).reshape(-1)
    assert generalist.act(observation) == int(generalist(params, layout, state))
    with pytest.raises(um.UserError, match="it should be"):
        generalist.act(observation[:-1])


@pytest.mark.slow
def test_the_shipped_policy_outlives_oldest_first(generalist):
    """Check 24 scenarios of the middle of the grid; `results/generalist` has the gain on all of it."""
    params = um.Params()

    @jax.jit
    def lifetimes(key):
        layout = um.sample_layout(key, params, 8, 8)
        keys = jax.random.split(key, 4)
        return [
            um.rollouts(policy, params, layout, keys).length
            for policy in (generalist, um.planning.HEURISTICS["oldest-first"])
        ]

    shipped, oldest_first = jax.vmap(lifetimes)(jax.random.split(jax.random.key(7), 24))
    assert shipped.mean() > 1.12 * oldest_first.mean()


@pytest.mark.slow
def test_the_forecast_holds_on_other_futures(generalist):
    params, layout = um.Params(), um.sample_layout(jax.random.key(11), um.Params(), 4, 8)
    advice = um.planning.advise(generalist, params, layout, samples=64)
    state, keys = um.initial_state(params, layout), jax.random.split(jax.random.key(5), 64)
    played = jax.jit(jax.vmap(lambda key: rollout_from(generalist, params, layout, state, key)))(keys)
    share = np.asarray(played.first_failure).mean(axis=0)
    assert np.abs(share - advice.forecast.first_failure).max() < 0.45
    assert abs(np.asarray(played.length).mean() - advice.forecast.lifetimes.mean()) < 1.5


def test_an_altered_policy_file_is_refused(tmp_path, generalist):
    from uavmec_jax.scenarios.policies import _SHIPPED

    content = bytearray((_SHIPPED / "generalist.npz").read_bytes())
    content[len(content) // 2] ^= 4
    (tmp_path / "mine.npz").write_bytes(content)
    with pytest.raises(um.UserError, match=r"mine\.npz"):
        load_policy(tmp_path / "mine.npz")


def test_a_policy_file_with_other_features_is_refused(tmp_path, monkeypatch, generalist):
    from uavmec_jax.scenarios import policy_files as collection

    generalist.save(tmp_path / "mine.npz")
    assert int(load_policy(tmp_path / "mine.npz").collection.n_devices) == 16
    monkeypatch.setattr(collection, "FEATURES", collection.FEATURES[:-1])
    with pytest.raises(um.UserError, match="see other features of a device than those of this version"):
        load_policy(tmp_path / "mine.npz")
