"""The type checker of the tests notices wrong fields at function boundaries and leaves constructors alone."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float, TypeCheckError, jaxtyped

from tests.small_scenarios import three_devices
from tests.typechecking import check_fields, checked
from uavmec_jax.env.dynamics import State, initial_state
from uavmec_jax.env.layout import Layout, Traffic
from uavmec_jax.env.observation import observe
from uavmec_jax.env.params import Params

PARAMS, LAYOUT = Params(n_devices=3), three_devices()
STATE = initial_state(PARAMS, LAYOUT)

WRONG_FIELDS = {
    "dtype": ({"age": jnp.zeros(3)}, r"State\.age is float32\[3\]; it should be .*Int"),
    "dtype of a NumPy array": ({"age": np.zeros(3)}, r"State\.age is float64\[3\]; it should be .*Int"),
    "Python number": ({"slot": 0.5}, r"State\.slot is 0\.5; it should be .*Int"),
    "shape": ({"uav_position": jnp.zeros(3)}, r"State\.uav_position is float32\[3\]; it should be .*batch K 2"),
    "rank": ({"battery": jnp.zeros(())}, r"State\.battery is float32\[\]; it should be .*batch n"),
    "another n": ({"age": jnp.zeros(4, jnp.int32)}, r"State\.age is int32\[4\]; it should be .*batch n"),
    "another batch": ({"slot": jnp.zeros(4, jnp.int32)}, r"State\.slot is int32\[4\]; it should be .*batch"),
}


class Pair(NamedTuple):
    first: Float[Array, " n"]
    second: Float[Array, " n"]


Pair.__module__ = "uavmec_jax.example"  # only the package's pytrees are checked


@jaxtyped(typechecker=checked)
def take_state(state: State) -> None:
    pass


@jaxtyped(typechecker=checked)
def make_state(**changes) -> State:
    return STATE.replace(**changes)


@jaxtyped(typechecker=checked)
def make_states(**changes) -> tuple[int, dict[str, list[State]]]:
    return 1, {"states": [STATE, STATE.replace(**changes)]}


@pytest.mark.parametrize(("changes", "message"), WRONG_FIELDS.values(), ids=WRONG_FIELDS)
def test_a_wrong_field_is_noticed_in_arguments_and_results(changes, message):
    with pytest.raises(TypeCheckError, match=message):
        check_fields(STATE.replace(**changes))
    with pytest.raises(TypeCheckError, match=r"parameters of tests\.test_typechecking\.take_state"):
        take_state(STATE.replace(**changes))
    with pytest.raises(TypeCheckError, match=r"return value of tests\.test_typechecking\.make_state\."):
        make_state(**changes)
    with pytest.raises(TypeCheckError, match=r"return value of tests\.test_typechecking\.make_states\."):
        make_states(**changes)


def test_a_wrong_field_of_a_nested_pytree_is_noticed():
    with pytest.raises(TypeCheckError, match=r"Traffic\.weight is float32\[3\]"):
        check_fields(LAYOUT.replace(traffic=Traffic(weight=jnp.ones(3))))
    with pytest.raises(TypeCheckError, match=r"Pair\.second is float32\[4\]"):
        check_fields({"pairs": [Pair(jnp.ones(3), jnp.ones(4))]})


def test_the_functions_of_the_package_are_checked():
    with pytest.raises(TypeCheckError, match=r"parameters of uavmec_jax\.env\.observation\.observe"):
        observe(PARAMS, LAYOUT, STATE.replace(age=jnp.zeros(3)))


def test_right_fields_are_accepted():
    batch = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (4, 2, *leaf.shape)), STATE)
    for state in (STATE, batch, jax.device_get(STATE), jax.device_get(batch)):
        take_state(state)
    assert make_states()[0] == 1
    jax.jit(jax.vmap(jax.vmap(take_state)))(batch)
    check_fields(Pair(jnp.ones(3), jnp.ones(3)))


@pytest.mark.parametrize(
    "tree", [PARAMS, STATE, LAYOUT.replace(traffic=Traffic(jnp.ones((2, 3))))], ids=lambda tree: type(tree).__name__
)
def test_constructors_accept_sentinels(tree):
    leaves, structure = jax.tree.flatten(tree)
    sentinel = object()
    sentinels = jax.tree.unflatten(structure, [sentinel] * len(leaves))
    assert all(leaf is sentinel for leaf in jax.tree.leaves(sentinels))
    check_fields(sentinels)  # only arrays and numbers are checked
    shapes = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, tree))
    chex.assert_trees_all_equal_shapes_and_dtypes(shapes, jax.tree.map(jnp.asarray, tree))


def test_constructors_accept_wrong_fields():
    assert Layout(*[None] * 9).traffic is None
    assert State(1, "two", None, object(), 0.5).slot == 0.5
