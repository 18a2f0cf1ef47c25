"""Golden numbers from purejaxql, the code of PQN's authors, with which our PQN is compared.

    git clone https://github.com/mttga/purejaxql ../purejaxql
    uv run python experiments/parity_purejaxql.py --purejaxql ../purejaxql --out tests/golden/purejaxql

Runs one update of the unmodified ``purejaxql/pqn_gymnax.py`` in an environment of random numbers and records the rollout, its
lambda targets, the weights before each gradient step, the gradients and the mean loss. What that file imports for logging,
for its command line and for gymnax's environments is replaced by stand-ins, because the update does not need it. The test in
tests/agents/test_pqn_parity.py reads the files; versions and settings are in versions.json.
"""

import argparse
import hashlib
import importlib.util
import json
import os
import sys
from importlib import metadata
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest import mock

os.environ["JAX_PLATFORMS"] = "cpu"

import jax
import jax.numpy as jnp
import numpy as np

N_ACTIONS, OBS_SIZE = 3, 6
SETTINGS: dict[str, Any] = {
    "NUM_ENVS": 5,
    "NUM_STEPS": 8,
    "NUM_MINIBATCHES": 1,
    "NUM_EPOCHS": 3,
    "GAMMA": 0.95,
    "LAMBDA": 0.65,
    "LR": 0.01,
    "MAX_GRAD_NORM": 10,
    "EPS_START": 0.5,
    "EPS_FINISH": 0.5,
    "EPS_DECAY": 0.1,
    "HIDDEN_SIZE": 8,
    "NUM_LAYERS": 2,
    "NORM_TYPE": "layer_norm",
    "TEST_NUM_STEPS": 1,
    "WANDB_MODE": "disabled",
    "ENV_NAME": "random",
}
"""One minibatch per pass, so that its order does not matter; three gradient steps per update."""
LAYERS = {f"Dense_{k}": f"TorchDense_{k}" for k in range(3)} | {f"LayerNorm_{k}": f"LayerNorm_{k}" for k in range(2)}
"""Their names of the layers and ours; the inputs' normalisation has no effect in their network."""


class RandomEnvironment:
    """Observations and rewards are normal; an episode ends with probability 0.15 in each slot."""

    def action_space(self, params: Any) -> SimpleNamespace:
        return SimpleNamespace(n=N_ACTIONS)

    def observation_space(self, params: Any) -> SimpleNamespace:
        return SimpleNamespace(shape=(OBS_SIZE,))

    def reset(self, key: jax.Array, params: Any) -> tuple[jax.Array, jax.Array]:
        return jax.random.normal(key, (OBS_SIZE,)), jnp.int32(0)

    def step(self, key: jax.Array, state: jax.Array, action: jax.Array, params: Any) -> tuple[Any, ...]:
        keys = jax.random.split(key, 3)
        reward, ended = jax.random.normal(keys[1]), jax.random.bernoulli(keys[2], 0.15)
        return jax.random.normal(keys[0], (OBS_SIZE,)), state + 1, reward, ended.astype(jnp.float32), {}


def stand_ins() -> dict[str, ModuleType]:
    """Return modules in place of those that one update does not need."""
    names = ("gymnax", "gymnax.wrappers", "gymnax.wrappers.purerl", "hydra", "omegaconf", "safetensors.flax", "wandb")
    modules: dict[str, Any] = {name: ModuleType(name) for name in (*names, "safetensors")}
    modules["gymnax"].make = lambda name: (RandomEnvironment(), SimpleNamespace(max_steps_in_episode=1))
    wrappers = modules["gymnax.wrappers.purerl"]
    wrappers.FlattenObservationWrapper = wrappers.LogWrapper = lambda env: env
    modules["hydra"].main = lambda **_: lambda function: function
    modules["omegaconf"].OmegaConf = None
    modules["safetensors.flax"].load_file = modules["safetensors.flax"].save_file = None
    return modules


def load_theirs(script: Path) -> Any:
    """Import their script."""
    spec = importlib.util.spec_from_file_location("pqn_gymnax", script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with mock.patch.dict(sys.modules, stand_ins()):
        spec.loader.exec_module(module)
    return module


def flat(prefix: str, params: dict[str, dict[str, jax.Array]]) -> dict[str, np.ndarray]:
    """Return a tree of weights as arrays with our names."""
    return {
        f"{prefix}/{ours}/{name}": np.asarray(leaf)
        for theirs, ours in LAYERS.items()
        for name, leaf in params[theirs].items()
    }


def one_update(theirs: Any) -> dict[str, np.ndarray]:
    """Run one update, and return what it read and computed."""
    slots: list[Any] = []
    targets: list[np.ndarray] = []
    steps: list[tuple[Any, Any]] = []
    transition, concatenate, state = theirs.Transition, jnp.concatenate, theirs.CustomTrainState

    def recorded_transition(**fields: Any) -> Any:
        slots.append(fields)
        return transition(**fields)

    def recorded_concatenate(arrays: Any, *arguments: Any, **named: Any) -> Any:
        joined = concatenate(arrays, *arguments, **named)
        if sys._getframe(1).f_code.co_filename == theirs.__file__:
            targets.append(np.asarray(joined))
        return joined

    class RecordedState(state):  # type: ignore[misc, valid-type]
        def apply_gradients(self, *, grads: Any, **named: Any) -> Any:
            steps.append((self.params, grads))
            return super().apply_gradients(grads=grads, **named)

    total = SETTINGS["NUM_ENVS"] * SETTINGS["NUM_STEPS"]
    settings = SETTINGS | {"TOTAL_TIMESTEPS": total, "TOTAL_TIMESTEPS_DECAY": total}
    with (
        jax.disable_jit(),
        mock.patch.object(theirs, "Transition", recorded_transition),
        mock.patch.object(theirs, "CustomTrainState", RecordedState),
        mock.patch.object(jnp, "concatenate", recorded_concatenate),
    ):
        result = theirs.make_train(settings)(jax.random.PRNGKey(0))
    assert len(targets) == 1
    assert len(steps) == SETTINGS["NUM_EPOCHS"]
    names = {"obs": "observation", "action": "action", "reward": "reward", "done": "ended", "q_val": "q_values"}
    rollout = {ours: np.stack([slot[name] for slot in slots]) for name, ours in names.items()}
    arrays = rollout | {
        "last_observation": np.asarray(slots[-1]["next_obs"]),
        "targets": targets[0],
        "mean_loss": np.asarray(result["metrics"]["td_loss"][0]),
    }
    for number, (weights, gradient) in enumerate(steps):
        arrays |= flat(f"weights_{number}", weights) | flat(f"gradient_{number}", gradient)
    return arrays


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--purejaxql", type=Path, required=True, help="a clone of the repository")
    parser.add_argument("--out", type=Path, default=Path("tests/golden/purejaxql"))
    arguments = parser.parse_args()
    script, out = arguments.purejaxql / "purejaxql" / "pqn_gymnax.py", arguments.out
    out.mkdir(parents=True, exist_ok=True)
    arrays = one_update(load_theirs(script))
    np.savez_compressed(out / "pqn.npz", **arrays)
    print(f"{len(arrays)} arrays, {(out / 'pqn.npz').stat().st_size / 1024:.0f} KiB")
    facts = {
        "command": "uv run python experiments/parity_purejaxql.py --purejaxql <clone> --out tests/golden/purejaxql",
        "script": {"path": "purejaxql/pqn_gymnax.py", "sha256": hashlib.sha256(script.read_bytes()).hexdigest()},
        "versions": {name: metadata.version(name) for name in ("jax", "flax", "optax", "numpy")},
        "settings": SETTINGS,
    }
    (out / "versions.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
