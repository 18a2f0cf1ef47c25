"""``um.train``: training from a script."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import uavmec_jax as um
from tests.populations import take


@pytest.fixture(scope="module")
def scenarios():
    def make(key, connected):
        return um.make_scenario(um.sample_layout(key, um.Params(), 12, connected), reward=um.make_reward("U"))

    return jax.vmap(make)(jax.random.split(jax.random.key(0), 3), np.array([12, 8, 8]))


@pytest.mark.slow
def test_a_sweep_over_learning_rates(scenarios):
    rates = np.array([7e-4, 7e-4, 1e30], np.float32)
    trained = um.train(
        "a2c",
        scenarios,
        key=jax.random.key(1),
        steps=2000,
        hyper={"learning_rate": rates, "gamma": 0.95},
        settings={"hidden": (16,), "n_envs": 2},
        validation=um.training.Validation(every=500, draws=4),
    )
    table = trained.table()
    assert table["learning_rate"].tolist() == rates.tolist()
    assert (table["gamma"] == np.float32(0.95)).all()
    assert (table["diverged_at"] >= 0).tolist() == [False, False, True]
    curves = trained.curve_table()
    assert curves.groupby("agent")["validation"].max().tolist() == table["best_validation"].tolist()
    first = take(scenarios, 0)
    episodes = um.rollouts(trained.policy(0), first.params, first.layout, jax.random.split(jax.random.key(3), 4))
    assert episodes.length.min() >= 5


@pytest.mark.slow
def test_the_best_q_learner_is_one_line(scenarios):
    paid_per_slot = jax.vmap(
        lambda scenario: um.make_scenario(scenario.layout, reward=um.make_reward({}, per_slot=1.0))
    )
    best = {**um.DQN_BEST, "steps": 8192, "settings": {"hidden": (16,)}}
    trained = um.train(scenarios=paid_per_slot(scenarios), key=jax.random.key(1), **best)
    assert trained.algorithm.name == "pqn"
    assert trained.result.validation.shape == (3, 1)
    assert (trained.table()["diverged_at"] == -1).all()


def test_the_preset_is_the_study():
    study = um.load_study("table5-best")
    assert (study.algorithm, study.steps) == (um.DQN_BEST["algorithm"], um.DQN_BEST["steps"])
    settings = {**um.DQN_BEST["hyper"], **um.DQN_BEST["settings"]}
    assert study.pqn == type(study.pqn)(**settings)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algorithm": "dqnn"}, "algorithm is 'dqnn'; did you mean 'dqn'"),
        (
            {"hyper": {"learning_rat": 1}},
            "hyper has 'learning_rat', which is not a hyperparameter of dqn; did you mean 'learning_rate'",
        ),
        ({"hyper": {"gamma": [0.9, 0.8]}}, r"hyper.gamma has shape \(2,\); give one number or 3 of them"),
        ({"settings": {"batchsize": 3}}, "settings has 'batchsize'; did you mean 'batch_size'"),
        (
            {"hyper": {"learning_rate": float("nan")}},
            "hyper.learning_rate is nan; it should be a finite number greater than 0",
        ),
        (
            {"hyper": {"learning_rate": [1e-3, 0.0, 1e-3]}},
            "hyper.learning_rate of agent 2 is 0; it should be a finite number",
        ),
        ({"hyper": {"gamma": -3}}, "hyper.gamma is -3; it should be a finite number from 0 to 1"),
        ({"settings": {"batch_size": 0}}, "settings: batch_size is 0; it should be greater than or equal to 1"),
        ({"settings": {"hidden": (0,)}}, "settings: hidden: item 1 is 0; it should be greater than or equal to 1"),
        ({"settings": {"double": "yes"}}, "settings: double is 'yes'; it should be true or false"),
        ({"steps": 0}, "steps is 0; it should be a whole number from 1 to 2000000000"),
        ({"steps": 3 * 10**9}, "steps is 3000000000; it should be a whole number from 1 to 2000000000"),
        (
            {"validation": um.training.Validation(draws=0)},
            r"validation\.draws is 0; it should be a whole number of at least 1",
        ),
        ({"validation": um.training.Validation(every=-1)}, r"validation\.every is -1; it should be a whole number"),
        (
            {"algorithm": "ppo", "steps": 2 * 10**9, "settings": {"batch_size": 8}},
            "settings: n_epochs is 10; with batch_size = 8 and steps = 2,000,000,000, there are 2,500,001,280 updates; there "
            "can be 2,147,483,647; lower n_epochs or steps, or raise batch_size",
        ),
        (
            {"algorithm": "a2c", "settings": {"n_steps": 1_000_000, "n_envs": 4096}},
            "settings: n_steps is 1000000; with n_envs = 4096, 1 iterations of 4,096,000,000 steps are 4,096,000,000; there "
            "can be 2,147,483,647; lower n_steps, n_envs or steps",
        ),
        ({"steps": 2 * 10**9, "settings": {"replay_capacity": 2 * 10**9}}, "steps is 2000000000: one agent needs"),
    ],
)
def test_bad_arguments_are_refused(scenarios, changes, message):
    arguments = {"algorithm": "dqn", "key": jax.random.key(0), "steps": 100} | changes
    with pytest.raises(um.UserError, match=message):
        um.train(arguments.pop("algorithm"), scenarios, **arguments)


def test_a_scenario_that_cannot_be_is_refused(scenarios):
    layout = scenarios.layout
    bad = scenarios.replace(layout=layout.replace(position=layout.position.at[1, 3].set(jnp.nan)))
    with pytest.raises(um.ArgumentError, match=r"^layout\.position of entry 2, device 4 is nan; it should be a finite"):
        um.train("dqn", bad, key=jax.random.key(0), steps=100)


def test_one_scenario_is_not_a_batch(scenarios):
    with pytest.raises(um.ArgumentError, match=r"scenarios\.layout\.capacity has shape"):
        um.train("dqn", take(scenarios, 0), key=jax.random.key(0), steps=100)


def test_fleets_and_a_dqn_with_a_horizon_are_refused(scenarios):
    key, n = jax.random.key(0), scenarios.layout.capacity.shape[0]
    fleet = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), um.env.make_fleet(um.Params(), 2))
    two = scenarios.replace(layout=scenarios.layout.replace(fleet=fleet))
    with pytest.raises(
        um.UserError, match="the layout has 2 UAVs and 0 depots; training is for one UAV without depots"
    ):
        um.train("ppo", two, key=key, steps=100)
    on = scenarios.replace(params=scenarios.params.replace(end="horizon"))
    with pytest.raises(
        um.UserError,
        match=r"params\.end is 'horizon', and algorithm is 'dqn', whose replay of the paper's observation holds no ages",
    ):
        um.train("dqn", on, key=key, steps=100)
