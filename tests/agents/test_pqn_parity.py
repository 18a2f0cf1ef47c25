"""PQN against purejaxql, from golden files that experiments/parity_purejaxql.py made with the authors' own code.

Their targets differ from ours in one place, which is the subject of a test. Their optimiser, RAdam, is not ours, so losses
and gradients are compared with their weights before each of three gradient steps.
"""

import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from uavmec_jax.agents import pqn
from uavmec_jax.agents.networks import QNetwork
from uavmec_jax.agents.q_targets import lambda_returns, widen_gap

GOLDEN = Path(__file__).parents[1] / "golden" / "purejaxql"
SETTINGS = json.loads((GOLDEN / "versions.json").read_text())["settings"]
HYPER = pqn.PQNHyper(age_scale=1.0)


class PlainSpec(pqn.PQNSpec):
    """Settings with their network, which is not dueling."""

    @property
    def network(self):
        return QNetwork(self.n_devices, self.hidden, dueling=False, layer_norm=True)


SPEC = PlainSpec(hidden=(8, 8), n_devices=3)


@functools.cache
def golden():
    with np.load(GOLDEN / "pqn.npz", allow_pickle=False) as arrays:
        return {key: jnp.asarray(arrays[key]) for key in arrays.files}


def tree(prefix):
    """Their weights or gradient, in our layout."""
    layers: dict = {}
    for name, leaf in golden().items():
        if name.startswith(prefix + "/"):
            _, layer, parameter = name.split("/")
            layers.setdefault(layer, {})[parameter] = leaf
    return {"params": layers}


def values():
    """Their values of the states before each slot, and of the states after the last one."""
    last = pqn.q_values(SPEC, HYPER, tree("weights_0"), golden()["last_observation"])
    return golden()["q_values"].max(axis=-1), last.max(axis=-1)


def our_targets(value, last_value):
    theirs = golden()
    ended, gamma, q_lambda = theirs["ended"].astype(bool), SETTINGS["GAMMA"], SETTINGS["LAMBDA"]
    uncut = jnp.full(ended.shape, True)
    return lambda_returns(theirs["reward"], value, last_value, ended, uncut, gamma, q_lambda)


def test_the_rollout_has_what_the_tests_need():
    ended = np.asarray(golden()["ended"])
    assert ended[:-1].any()
    assert not ended[-1].any()
    greedy = np.asarray(golden()["q_values"]).argmax(axis=-1) == golden()["action"]
    assert 0.3 < greedy.mean() < 0.95


def test_q_values():
    theirs = golden()
    ours = pqn.q_values(SPEC, HYPER, tree("weights_0"), theirs["observation"].reshape(-1, 6))
    assert_allclose(ours.reshape(theirs["q_values"].shape), theirs["q_values"], rtol=1e-5, atol=1e-6)


def test_targets():
    """They take the value after the last slot for the value before it, too; that apart, the targets are the same."""
    value, last_value = values()
    assert_allclose(our_targets(value.at[-1].set(last_value), last_value), golden()["targets"], rtol=1e-5, atol=1e-6)


def test_targets_differ_only_where_the_value_before_the_last_slot_is_used():
    theirs, ours = np.asarray(golden()["targets"]), np.asarray(our_targets(*values()))
    ended = np.asarray(golden()["ended"], bool)[:-1]
    uses = np.flip(np.logical_and.accumulate(np.flip(~ended, 0)), 0)  # no episode ends from here to the last slot
    same = np.vstack([~uses, np.full(5, True)])
    assert 5 < same.sum() < same.size
    assert_allclose(ours[same], theirs[same], rtol=1e-5, atol=1e-6)
    value, last_value = values()
    one_step = SETTINGS["GAMMA"] * (1.0 - SETTINGS["LAMBDA"]) * (value[-1] - last_value)
    assert_allclose((ours - theirs)[-2], np.where(ended[-1], 0.0, one_step), rtol=1e-4, atol=1e-6)


def samples():
    theirs = golden()
    return pqn.Samples(
        observation=theirs["observation"].reshape(-1, 6),
        action=theirs["action"].reshape(-1).astype(jnp.int32),
        target=widen_gap(theirs["targets"], theirs["q_values"], theirs["action"], 0.0).reshape(-1),
    )


def test_no_gap_leaves_the_targets_as_they_are():
    assert_array_equal(samples().target, golden()["targets"].reshape(-1))


def test_losses_and_gradients(jit):
    loss_of = jit(jax.value_and_grad(functools.partial(pqn.pqn_loss, SPEC, HYPER)))
    losses = []
    for step in range(SETTINGS["NUM_EPOCHS"]):
        loss, gradient = loss_of(tree(f"weights_{step}"), samples())
        losses.append(float(loss))
        theirs = tree(f"gradient_{step}")
        assert jax.tree.structure(gradient) == jax.tree.structure(theirs)
        for ours, their in zip(*map(jax.tree.leaves, (gradient, theirs)), strict=True):
            assert np.linalg.norm(ours - their) <= 1e-5 * max(np.linalg.norm(their), 1e-2)
    assert losses[0] > losses[-1]
    assert np.mean(losses) == pytest.approx(float(golden()["mean_loss"]), rel=1e-5)
