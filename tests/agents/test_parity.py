"""The algorithms against Stable-Baselines3, from golden files that experiments/parity_sb3.py made with the library itself."""

import functools
import json
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from tests.populations import differs, make_agent, over_agents, stack
from uavmec_jax.agents import a2c, actor_critic, dqn, gae, ppo
from uavmec_jax.agents.collect_rollout import Samples
from uavmec_jax.agents.optimizers import TrainState, clipped_adam, clipped_rmsprop
from uavmec_jax.agents.replay import Transition

GOLDEN = Path(__file__).parents[1] / "golden" / "sb3"
CLOSE = 1e-5
"""Relative difference of whole tensors."""


def golden(name):
    with np.load(GOLDEN / f"{name}.npz", allow_pickle=False) as arrays:
        return {key: arrays[key] for key in arrays.files}


def tree(arrays, prefix, layers):
    """Convert PyTorch's ``<layer>.weight`` and ``.bias`` under ``prefix``; ``layers`` maps our paths to their layers."""
    params: dict = {}
    for ours, theirs in layers.items():
        *parents, last = ours.split("/")
        parent = functools.reduce(lambda at, name: at.setdefault(name, {}), parents, params)
        parent[last] = {
            "kernel": jnp.asarray(arrays[f"{prefix}/{theirs}.weight"].T),
            "bias": jnp.asarray(arrays[f"{prefix}/{theirs}.bias"]),
        }
    return {"params": params}


DQN_LAYERS = {f"TorchDense_{i}": f"q_net.{2 * i}" for i in range(3)}
ACTOR_CRITIC_LAYERS = {
    "policy/OrthogonalDense_0": "mlp_extractor.policy_net.0",
    "policy/OrthogonalDense_1": "mlp_extractor.policy_net.2",
    "policy/OrthogonalDense_2": "action_net",
    "critic/OrthogonalDense_0": "mlp_extractor.value_net.0",
    "critic/OrthogonalDense_1": "mlp_extractor.value_net.2",
    "critic/OrthogonalDense_2": "value_net",
}


def assert_near(ours, theirs):
    """Assert that every tensor has a relative difference (Euclidean norm) of at most 1e-5."""
    chex.assert_trees_all_equal_structs(ours, theirs)
    for our, their in zip(*map(jax.tree.leaves, (ours, theirs)), strict=True):
        assert np.linalg.norm(our - their) <= CLOSE * max(np.linalg.norm(their), 1e-3)


def clipped(gradient, max_norm):
    factor = jnp.minimum(max_norm / (optax.tree.norm(gradient) + 1e-6), 1.0)
    return jax.tree.map(lambda g: g * factor, gradient)


def test_dqn_updates():
    theirs, spec, hyper = golden("dqn"), dqn.DQNSpec(), dqn.DQNHyper()
    weights, target = tree(theirs, "weights_0", DQN_LAYERS), tree(theirs, "target", DQN_LAYERS)
    state = dqn.init(spec, make_agent()).replace(weights=weights, target=target)
    state = state.replace(opt_state=clipped_adam().init(weights), buffer_state=None)
    loss_of = jax.jit(jax.value_and_grad(lambda w, batch: dqn.td_loss(spec, hyper, w, target, batch)))
    gradient_step = jax.jit(functools.partial(dqn._gradient_step, spec, hyper))
    losses = []
    for k in range(10):
        column = lambda name, k=k: jnp.asarray(theirs[name][k, :, 0])  # noqa: E731
        batch = Transition(
            observation=jnp.asarray(theirs["observations"][k]),
            action=column("actions").astype(jnp.int32),
            reward=column("rewards"),
            terminated=column("dones"),
            next_observation=jnp.asarray(theirs["next_observations"][k]),
            discount=jnp.full(16, hyper.gamma),
        )
        if k == 0:
            _, gradient = loss_of(state.weights, batch)
            assert_near(clipped(gradient, hyper.max_grad_norm), tree(theirs, "gradient", DQN_LAYERS))
        state = gradient_step(state, batch, 104 + 4 * k)
        losses.append(float(state.loss))
        if k == 0:
            assert_near(state.weights, tree(theirs, "weights_1", DQN_LAYERS))
    assert_allclose(losses, theirs["losses"], rtol=CLOSE)
    assert_near(state.weights, tree(theirs, "weights_10", DQN_LAYERS))


def samples(arrays, *index):
    at = lambda name: jnp.asarray(arrays[name][index] if index else arrays[name])  # noqa: E731
    return Samples(
        observation=at("observations"),
        action=at("actions")[..., 0].astype(jnp.int32),
        advantage=at("advantages"),
        returns=at("returns"),
        log_prob=at("log_probs"),
    )


def test_ppo_epoch():
    theirs, hyper = golden("ppo"), ppo.PPOHyper()
    weights = tree(theirs, "weights_0", ACTOR_CRITIC_LAYERS)
    rollout = jax.tree.map(lambda leaf: leaf[theirs["order"]], samples(theirs))
    rows = ppo._rows(rollout)
    first = jax.tree.map(lambda leaf: leaf[:64], rollout)
    loss_of = jax.value_and_grad(lambda w: ppo.ppo_loss(ppo.PPOSpec(), hyper, w, first))
    loss, gradient = jax.jit(loss_of)(weights)
    assert_allclose(loss, theirs["losses"][0], rtol=CLOSE)
    assert_near(clipped(gradient, hyper.max_grad_norm), tree(theirs, "gradient", ACTOR_CRITIC_LAYERS))

    train_state = TrainState(weights, clipped_adam(eps=1e-5).init(weights), jnp.int32(-1))
    for minibatches in (1, 10, 32):
        spec = ppo.PPOSpec(n_steps=64 * minibatches)
        train_epoch = jax.jit(functools.partial(ppo.train_epoch, spec, hyper))
        after, loss = train_epoch(train_state, rows[: 64 * minibatches], 1, 2048)
        assert_allclose(loss, theirs["losses"][minibatches - 1], rtol=CLOSE)
        assert_near(after.weights, tree(theirs, f"weights_{minibatches}", ACTOR_CRITIC_LAYERS))


def test_a2c_updates():
    theirs, spec, hyper = golden("a2c"), a2c.A2CSpec(), a2c.A2CHyper()
    weights = tree(theirs, "weights_0", ACTOR_CRITIC_LAYERS)
    train_state = TrainState(weights, clipped_rmsprop().init(weights), jnp.int32(-1))
    loss_of = jax.jit(jax.value_and_grad(lambda w: a2c.a2c_loss(spec, hyper, w, samples(theirs, 0))))
    _, gradient = loss_of(weights)
    assert_near(clipped(gradient, hyper.max_grad_norm), tree(theirs, "gradient", ACTOR_CRITIC_LAYERS))
    gradient_step = jax.jit(functools.partial(a2c.gradient_step, spec, hyper))
    losses = []
    for k in range(10):
        train_state, loss = gradient_step(train_state, samples(theirs, k), 5 * (k + 1))
        losses.append(float(loss))
        if k == 0:
            assert_near(train_state.weights, tree(theirs, "weights_1", ACTOR_CRITIC_LAYERS))
    assert_allclose(losses, theirs["losses"], rtol=CLOSE)
    assert_near(train_state.weights, tree(theirs, "weights_10", ACTOR_CRITIC_LAYERS))


@pytest.mark.parametrize(("name", "gae_lambda", "index"), [("ppo", 0.95, ()), ("a2c", 1.0, (3,))])
def test_values_log_probabilities_and_advantages(jit, name, gae_lambda, index):
    theirs = golden(name)
    rollout = samples(theirs, *index)
    at = lambda key: theirs[key][index] if index else theirs[key]  # noqa: E731
    if not index:  # the rollout was played with the weights before the first update
        weights, spec, hyper = tree(theirs, "weights_0", ACTOR_CRITIC_LAYERS), ppo.PPOSpec(), ppo.PPOHyper()
        logits, values = jit(functools.partial(actor_critic.logits_and_value, spec, hyper))(
            weights, rollout.observation
        )
        assert_allclose(values, at("values"), rtol=1e-4, atol=1e-5)
        assert_allclose(jit(gae.log_prob_and_entropy)(logits, rollout.action)[0], at("log_probs"), rtol=1e-5)
    # SB3 stores where an episode starts; it ended the slot before. The value after the last slot follows from its advantage.
    ended = np.append(at("episode_starts")[1:], 0).astype(bool)
    last_value = (at("advantages")[-1] - at("rewards")[-1] + at("values")[-1]) / 0.98
    columns = (jnp.asarray(at(key))[:, None] for key in ("rewards", "values"))
    advantages = jit(gae.generalized_advantages)(
        *columns, jnp.array([last_value]), jnp.asarray(ended)[:, None], 0.98, gae_lambda
    )
    assert_allclose(advantages[:, 0], at("advantages"), rtol=1e-4, atol=1e-4)
    assert_allclose(rollout.returns, at("advantages") + at("values"), rtol=1e-6)


def test_epsilon():
    theirs = golden("epsilon")
    assert len(theirs["steps"]) == 20
    ours = [dqn.epsilon(dqn.DQNHyper(), 1_000_000, step) for step in theirs["steps"]]
    assert_allclose(ours, theirs["epsilon"], rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "layers"), [("dqn", DQN_LAYERS), ("ppo", ACTOR_CRITIC_LAYERS)])
def test_initial_weights_come_from_the_same_distribution(name, layers):
    theirs = golden("initial")
    network = dqn.DQNSpec().network if name == "dqn" else ppo.PPOSpec().network
    init = jax.jit(jax.vmap(lambda key: network.init(key, jnp.zeros((1, 24)))))
    weights = init(jax.random.split(jax.random.key(0), 40))["params"]
    for path, layer in layers.items():
        our_layer = functools.reduce(lambda at, part: at[part], path.split("/"), weights)
        for leaf, tensor in (("kernel", "weight"), ("bias", "bias")):
            our, their = np.ravel(our_layer[leaf]), theirs[f"{name}/{layer}.{tensor}"]
            if not their.any():
                assert not our.any()
                continue
            # With a few thousand weights each, a gain that is off by 15 % is detected.
            assert stats.ks_2samp(our, their).pvalue > 1e-3, layer


def test_their_environment_checker_passed_ours():
    assert json.loads((GOLDEN / "versions.json").read_text())["check_env"] == "passed"


@pytest.mark.slow
def test_order_of_target_copies_and_gradient_steps():
    facts = json.loads((GOLDEN / "versions.json").read_text())
    spec = dqn.DQNSpec(total_steps=10_008)
    agents = stack([make_agent(0)])
    update = over_agents(functools.partial(dqn.update, spec), 0, 0, None, None)
    state, events = over_agents(functools.partial(dqn.init, spec), 0)(agents), []
    for first, last in ((24, 28), (2498, 2502)):
        state = update(agents, state, 0 if first == 24 else 28, first)
        for i in range(first, last):
            before, state = state, update(agents, state, i, i + 1)
            if any(differs(before.target, state.target)):
                events.append([4 * i + 4, "target copy"])
                chex.assert_trees_all_equal(state.target, before.weights)  # copied before the gradient step
            if any(differs(before.weights, state.weights)):
                events.append([4 * i + 4, "gradient step"])
    assert events == facts["order"]
