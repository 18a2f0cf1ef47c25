"""Policy files with a right checksum and wrong contents are refused in one line; nothing in them is computed with."""

import copy
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import traverse_util
from numpy.testing import assert_array_equal

from uavmec_jax.agents.dqn import DQNSpec
from uavmec_jax.agents.settings import SETTINGS
from uavmec_jax.errors import PolicyError
from uavmec_jax.files.archives import write_checked
from uavmec_jax.scenarios.policies import load_policy
from uavmec_jax.scenarios.policy_files import read_policies, write_policies
from uavmec_jax.scenarios.policy_schema import network_shapes

SHIPPED = load_policy("generalist").collection

KERNEL = "dqn/best/params/TorchDense_0/kernel"


def good_file():
    """Return the header and the weights of a file of two agents."""
    weights = jax.vmap(lambda key: DQNSpec(hidden=(4,)).network.init(key, jnp.zeros((1, 24))))(
        jax.random.split(jax.random.key(0), 2)
    )
    agents = [{"seed": seed, "powered": 8, "connected": 8, "gamma": 0.9} for seed in (0, 1)]
    header = {
        "settings": {"dqn": SETTINGS["dqn"](hidden=(4,)).model_dump(mode="json")},
        "n_devices": 12,
        "agents": {"dqn": agents},
    }
    flat = traverse_util.flatten_dict({"dqn": {"best": weights}}, sep="/")
    return header, {key: np.asarray(leaf) for key, leaf in flat.items()}


HEADER, WEIGHTS = good_file()
DRAWN = json.loads(json.dumps(dict(SHIPPED.drawn)))


def write_with(path, header=None, weights=None):
    """Write the good file with changes, and with the checksum that belongs to them; ``None`` removes an entry."""
    facts, arrays = copy.deepcopy(HEADER), dict(WEIGHTS)
    for dotted, value in (header or {}).items():
        *parents, last = (int(part) if part.isdigit() else part for part in dotted.split("."))
        table = facts
        for parent in parents:
            table = table[parent]
        if value is None:
            del table[last]
        else:
            table[last] = value
    for key, leaf in (weights or {}).items():
        if leaf is None:
            del arrays[key]
        else:
            arrays[key] = leaf
    write_checked(path, 1, facts, arrays)
    return path


def refused(path):
    with pytest.raises(PolicyError) as error:
        load_policy(path, seed=0)
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert message.isprintable()
    assert len(message) <= 400
    return message


def test_the_good_file_and_the_shipped_policy_are_read_to_the_bit(tmp_path):
    policy = load_policy(write_with(tmp_path / "p.npz", {"drawn": DRAWN}), seed=1)
    assert policy.trained_on["seed"] == 1
    assert_array_equal(policy.collection.weights[KERNEL], WEIGHTS[KERNEL][1:])
    write_policies(tmp_path / "again.npz", SHIPPED)
    again = read_policies(tmp_path / "again.npz")
    assert (again.settings, again.n_devices, again.agents) == (SHIPPED.settings, SHIPPED.n_devices, SHIPPED.agents)
    assert again.drawn == SHIPPED.drawn
    for key, leaf in SHIPPED.weights.items():
        assert again.weights[key].tobytes() == leaf.tobytes()


BAD_HEADERS = {
    "no settings": ({"settings": None}, "its header has no settings"),
    "empty settings": ({"settings": {}}, "settings is {}"),
    "settings as a list": ({"settings": [1]}, "settings is [1]; it should be a table"),
    "unknown algorithm": ({"settings.sarsa": {}}, "settings.sarsa is not an algorithm of this version; known: dqn"),
    "algorithm without agents": ({"settings.ppo": {}}, "agents.ppo is missing; settings.ppo is given"),
    "agents without settings": ({"agents.ppo": [{"seed": 0}]}, "settings.ppo is missing; agents.ppo is given"),
    "unknown setting": ({"settings.dqn.gama": 0.9}, "settings.dqn: gama is not a setting; did you mean 'gamma'?"),
    "text as a number": ({"settings.dqn.gamma": "high"}, "settings.dqn: gamma is 'high'; it should be a number"),
    "out of bounds": ({"settings.dqn.age_scale": -1.0}, "settings.dqn: age_scale is -1.0; it should be greater than 0"),
    "tiny": (
        {"settings.dqn.age_scale": 1e-300},
        "settings.dqn: age_scale is 1e-300; it should be 0, or at least 1e-12",
    ),
    "huge network": (
        {"settings.dqn.hidden": [10**9]},
        "hidden: item 1 is 1000000000; it should be less than or equal to 4096",
    ),
    "deep network": ({"settings.dqn.hidden": [4] * 100_000}, "hidden"),
    "number beyond int64": ({"settings.dqn.learning_starts": 10**30}, "learning_starts is 1"),
    "unknown choice": ({"settings.dqn.observation": "all"}, "observation is 'all'; it should be 'paper' or 'full'"),
    "another network": ({"settings.dqn.hidden": [5]}, "its weights do not fit its dqn network of this version"),
    "devices beyond the replay": ({"n_devices": 999}, "settings.dqn: n_devices is 999; a DQN replay holds at most"),
    "no devices": ({"n_devices": 0}, "n_devices is 0; it should be greater than or equal to 1"),
    "many devices": ({"n_devices": 10**9}, "n_devices is 1000000000; it should be less than or equal to 1000"),
    "other devices": ({"n_devices": 11}, "its weights do not fit its dqn network of this version"),
    "devices as text": ({"n_devices": "12"}, "n_devices is '12'; it should be a whole number"),
    "no agents": ({"agents.dqn": []}, "agents.dqn is []"),
    "agents as a number": ({"agents": 3}, "agents is 3; it should be a table"),
    "agent as a number": ({"agents.dqn.1": 3}, "agents.dqn: item 2 is 3; it should be a table"),
    "one agent too many": ({"agents.dqn": HEADER["agents"]["dqn"] * 2}, "its weights do not fit its dqn network"),
    "table in an agent": ({"agents.dqn.0.seed": {"a": 1}}, "agents.dqn: item 1: seed is {'a': 1}"),
    "agent's own setting": (
        {"agents.dqn.1.gamma": 7.0},
        "agent 2 of dqn: gamma is 7.0; it should be less than or equal",
    ),
    "terminal's words": ({"agents.dqn.0.place": "\x1b[2J"}, "it should be one line of characters that can be printed"),
    "drawn as text": ({"drawn": "drawn"}, "drawn is 'drawn'"),
    "drawn without parameters": ({"drawn": {"scenarios": DRAWN["scenarios"]}}, "drawn.params is missing"),
    "drawn without a region": (
        {"drawn": {"scenarios": DRAWN["scenarios"], "params": {}}},
        "drawn.params.device_battery_range_j is missing",
    ),
    "drawn from falling ranges": (
        {"drawn": {"scenarios": DRAWN["scenarios"] | {"region_m": [9.0, 1.0]}, "params": DRAWN["params"]}},
        "scenarios.region_m is [9.0, 1.0]; give [low, high] with 0 < low <= high",
    ),
    "unknown fact": ({"colour": 1}, "colour is not a setting"),
}


@pytest.mark.parametrize(("changes", "message"), BAD_HEADERS.values(), ids=BAD_HEADERS)
def test_a_header_that_is_not_what_it_should_be_is_refused_in_one_line(tmp_path, changes, message):
    assert message in refused(write_with(tmp_path / "p.npz", changes))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_weights_that_are_not_finite_are_refused(tmp_path, value):
    leaf = WEIGHTS[KERNEL].copy()
    leaf[0, 3, 2] = value
    path = write_with(tmp_path / "p.npz", weights={KERNEL: leaf})
    assert "the best weights of dqn are not finite: training diverged" in refused(path)
    assert load_policy(path, seed=1).trained_on["seed"] == 1  # the other agent's


@pytest.mark.parametrize("dtype", ["complex64", "bool", "float64", "float16", "int32", "uint8", ">f4"])
def test_weights_of_another_type_are_refused(tmp_path, dtype):
    path = write_with(tmp_path / "p.npz", weights={KERNEL: WEIGHTS[KERNEL].astype(dtype)})
    message = refused(path)
    assert "should be float32" in message or "numbers, truth values and text are read" in message


@pytest.mark.parametrize(
    "changes",
    [
        {KERNEL: WEIGHTS[KERNEL][:, :, :-1]},
        {KERNEL: WEIGHTS[KERNEL][:1]},
        {KERNEL: WEIGHTS[KERNEL].reshape(-1)},
        {KERNEL: None},
        {KERNEL.replace("best", "worst"): WEIGHTS[KERNEL]},
        {KERNEL.replace("best", "last"): WEIGHTS[KERNEL]},
        {KERNEL.replace("dqn", "ppo"): WEIGHTS[KERNEL]},
        {"kernel": WEIGHTS[KERNEL]},
        dict.fromkeys(WEIGHTS),
    ],
    ids=["shape", "agents", "flat", "missing", "unknown kind", "half a kind", "unknown algorithm", "no path", "none"],
)
def test_weights_that_do_not_fit_are_refused(tmp_path, changes):
    assert "weights do not fit" in refused(write_with(tmp_path / "p.npz", weights=changes))


def test_the_shapes_of_a_large_network_take_no_memory():
    assert max(np.prod(shape) for shape in network_shapes(DQNSpec(hidden=(4096,) * 32), 10**6).values()) > 10**13


def test_the_header_of_a_run_is_as_strict(tmp_path):
    (tmp_path / "run").mkdir()
    write_with(tmp_path / "run" / "weights.npz", {"n_devices": True})
    with pytest.raises(PolicyError, match="n_devices is True; it should be a whole number"):
        load_policy(tmp_path / "run", seed=0)


@pytest.mark.parametrize("path", ["a\0b.npz", "a" * 5000, f"{'a/' * 3000}b.npz", "", "/dev/zero"])
def test_what_is_the_path_of_no_policy_is_refused_at_once(path):
    with pytest.raises(PolicyError) as error:
        load_policy(path)
    assert len(str(error.value)) <= 400
