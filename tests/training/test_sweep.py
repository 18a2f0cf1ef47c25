"""Training from a script of one's own."""

import jax
import numpy as np
import pytest

import uavmec_jax as um


@pytest.fixture(scope="module")
def scenarios():
    def make(key, connected):
        return um.make_scenario(um.sample_layout(key, um.Params(), 12, connected), reward=um.make_reward("U"))

    return jax.vmap(make)(jax.random.split(jax.random.key(0), 3), np.array([12, 8, 8]))


@pytest.mark.slow
def test_a_sweep_of_ones_own(scenarios):
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
    first = jax.tree.map(lambda leaf: leaf[0], scenarios)
    world = (first.params, first.layout)
    played = um.rollouts(trained.policy(0), *world, jax.random.split(jax.random.key(3), 4))
    assert played.length.min() >= 5


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"algorithm": "dqnn"}, "algorithm is 'dqnn'; did you mean 'dqn'"),
        (
            {"hyper": {"learning_rat": 1}},
            "hyper has 'learning_rat', which is not one of dqn; did you mean 'learning_rate'",
        ),
        ({"hyper": {"gamma": [0.9, 0.8]}}, r"hyper.gamma has shape \(2,\); give one number or 3 of them"),
        ({"settings": {"batchsize": 3}}, "settings has 'batchsize'; did you mean 'batch_size'"),
        ({"steps": 2 * 10**9, "settings": {"replay_capacity": 2 * 10**9}}, "steps is 2000000000: one agent needs"),
    ],
)
def test_what_cannot_be_trained_is_said(scenarios, changes, line):
    wanted = {"algorithm": "dqn", "key": jax.random.key(0), "steps": 100} | changes
    with pytest.raises(um.UserError, match=line):
        um.train(wanted.pop("algorithm"), scenarios, **wanted)
