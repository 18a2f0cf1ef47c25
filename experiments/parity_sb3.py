"""Golden numbers from Stable-Baselines3 itself, with which our algorithms are compared update by update.

    uv run --group sb3 python experiments/parity_sb3.py --out tests/golden/sb3

Plays and learns with the library's own DQN, PPO and A2C, recording every minibatch, loss, clipped gradient and the weights
around each step; epsilon over the steps; initial weights; and the order of target copies and gradient steps. The tests
in tests/agents/test_parity.py read the files; versions are in versions.json.
"""

import argparse
import json
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any
from unittest import mock

os.environ["JAX_PLATFORMS"] = "cpu"

import gymnasium
import numpy as np
import torch
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common import logger
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.dqn import dqn as sb3_dqn

import uavmec_jax.interop  # noqa: F401  (registers UavMec-v0)

TABLE_4 = {"learning_rate": 0.0071, "batch_size": 16, "gamma": 0.98, "exploration_fraction": 0.35}
UPDATES = 10


def environment() -> gymnasium.Env:
    return gymnasium.make("UavMec-v0")


def weights_of(module: torch.nn.Module) -> dict[str, np.ndarray]:
    return {name: tensor.detach().numpy().copy() for name, tensor in module.named_parameters()}


class Recorder:
    """Losses, clipped gradients and weights of every gradient step of a model."""

    def __init__(self, module: torch.nn.Module, optimizer: torch.optim.Optimizer) -> None:
        self.module, self.optimizer = module, optimizer
        self.losses: list[float] = []
        self.gradients: list[dict[str, np.ndarray]] = []
        self.weights = [weights_of(module)]

    @contextmanager
    def recording(self) -> Iterator[None]:
        backward, step = torch.Tensor.backward, self.optimizer.step

        def noted_backward(loss: torch.Tensor, *arguments: Any, **named: Any) -> None:
            self.losses.append(loss.item())
            backward(loss, *arguments, **named)

        def noted_step(*arguments: Any, **named: Any) -> None:
            parameters = self.module.named_parameters()
            self.gradients.append({n: p.grad.numpy().copy() for n, p in parameters if p.grad is not None})
            step(*arguments, **named)
            self.weights.append(weights_of(self.module))

        with (
            mock.patch.object(torch.Tensor, "backward", noted_backward),
            mock.patch.object(self.optimizer, "step", noted_step),
        ):
            yield

    def arrays(self, *steps: int) -> dict[str, np.ndarray]:
        """Losses of all steps; gradients of the first; weights after the given numbers of steps."""
        kept = {f"weights_{step}/{name}": leaf for step in (0, *steps) for name, leaf in self.weights[step].items()}
        kept |= {f"gradient/{name}": leaf for name, leaf in self.gradients[0].items()}
        return kept | {"losses": np.array(self.losses, np.float32)}


def quiet(model: Any) -> Any:
    model.set_logger(logger.configure(None, []))
    return model


def dqn_updates() -> dict[str, np.ndarray]:
    model = DQN("MlpPolicy", environment(), **TABLE_4, buffer_size=4000, learning_starts=10_000, seed=0, device="cpu")
    quiet(model).learn(2000)
    with torch.no_grad():
        for parameter in model.q_net_target.parameters():
            parameter.mul_(1.1)
    batches = [model.replay_buffer.sample(16) for _ in range(UPDATES)]
    recorder = Recorder(model.q_net, model.policy.optimizer)
    with mock.patch.object(model.replay_buffer, "sample", side_effect=batches), recorder.recording():
        model.train(gradient_steps=UPDATES, batch_size=16)
    names = ("observations", "actions", "rewards", "dones", "next_observations")
    data = {name: np.stack([getattr(batch, name).numpy() for batch in batches]) for name in names}
    target = {f"target/{name}": leaf for name, leaf in weights_of(model.q_net_target).items()}
    return recorder.arrays(1, UPDATES) | target | data


def ppo_epoch() -> dict[str, np.ndarray]:
    model = quiet(PPO("MlpPolicy", environment(), gamma=0.98, n_epochs=1, seed=0, device="cpu"))
    buffer = play(model)
    order = np.random.default_rng(0).permutation(model.n_steps)
    recorder = Recorder(model.policy, model.policy.optimizer)
    data = rollout_of(buffer) | {"order": order}
    with mock.patch("numpy.random.permutation", return_value=order), recorder.recording():
        model.train()
    return recorder.arrays(1, UPDATES, model.n_steps // model.batch_size) | data


def a2c_updates() -> dict[str, np.ndarray]:
    model = quiet(A2C("MlpPolicy", environment(), gamma=0.98, seed=0, device="cpu"))
    recorder = Recorder(model.policy, model.policy.optimizer)
    rollouts = []
    for _ in range(UPDATES):
        rollouts.append(rollout_of(play(model)))
        with recorder.recording():
            model.train()
    data = {name: np.stack([rollout[name] for rollout in rollouts]) for name in rollouts[0]}
    return recorder.arrays(1, UPDATES) | data


def play(model: Any) -> Any:
    """Fill the model's rollout buffer once."""
    if model._last_obs is None:
        _, callback = model._setup_learn(10**6)
        model._callback = callback
    model.collect_rollouts(model.env, model._callback, model.rollout_buffer, model.n_steps)
    return model.rollout_buffer


def rollout_of(buffer: Any) -> dict[str, np.ndarray]:
    """The rollout of one environment, as it was played."""
    names = ("observations", "actions", "rewards", "values", "log_probs", "advantages", "returns", "episode_starts")
    return {name: getattr(buffer, name)[:, 0].copy() for name in names}


def epsilons(total_steps: int = 1_000_000, points: int = 20) -> dict[str, np.ndarray]:
    model = DQN("MlpPolicy", environment(), **TABLE_4, buffer_size=100, device="cpu")
    steps = np.linspace(0, total_steps, points).astype(int)
    return {"steps": steps, "epsilon": np.array([model.exploration_schedule(1 - step / total_steps) for step in steps])}


def initial_weights(networks: int = 40) -> dict[str, np.ndarray]:
    """Sorted sample of every layer's weights over many networks."""
    made: dict[str, list[np.ndarray]] = {}
    for kind, name in ((DQN, "dqn"), (PPO, "ppo")):
        for seed in range(networks):
            more = {"buffer_size": 10} if kind is DQN else {}
            model = kind(
                "MlpPolicy", environment(), seed=seed, device="cpu", policy_kwargs={"net_arch": [64, 64]}, **more
            )
            module = model.q_net if kind is DQN else model.policy
            for layer, leaf in weights_of(module).items():
                made.setdefault(f"{name}/{layer}", []).append(leaf.ravel())
    rng = np.random.default_rng(0)
    pooled = {name: np.concatenate(leaves) for name, leaves in made.items()}
    return {name: np.sort(rng.choice(leaf, min(leaf.size, 2000), replace=False)) for name, leaf in pooled.items()}


def order_of_events() -> list[tuple[int, str]]:
    """(environment steps, what happened) around the start of learning and the first copy of the target."""
    model = quiet(DQN("MlpPolicy", environment(), **TABLE_4, buffer_size=20_000, seed=0, device="cpu"))
    events: list[tuple[int, str]] = []
    train, copy = model.train, sb3_dqn.polyak_update

    def noted_train(*arguments: Any, **named: Any) -> None:
        events.append((model.num_timesteps, "gradient step"))
        train(*arguments, **named)

    def noted_copy(weights: Any, target: Any, tau: float) -> None:
        weights = list(weights)
        if weights:  # not the empty running statistics
            events.append((model.num_timesteps, "target copy"))
        copy(weights, target, tau)

    with mock.patch.object(model, "train", noted_train), mock.patch.object(sb3_dqn, "polyak_update", noted_copy):
        model.learn(10_008)
    return [(step, what) for step, what in events if 100 <= step <= 112 or 9_996 <= step <= 10_008]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("tests/golden/sb3"))
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    warnings.simplefilter("error")
    made = {
        "dqn": dqn_updates(),
        "ppo": ppo_epoch(),
        "a2c": a2c_updates(),
        "epsilon": epsilons(),
        "initial": initial_weights(),
    }
    for name, arrays in made.items():
        np.savez_compressed(out / f"{name}.npz", **arrays)
        print(f"{name}: {len(arrays)} arrays, {(out / f'{name}.npz').stat().st_size / 1024:.0f} KiB")
    packages = ("stable-baselines3", "torch", "gymnasium", "numpy", "jax")
    check_env(environment().unwrapped)  # raises, or warns, if it finds anything
    facts = {
        "check_env": "passed",
        "command": "uv run --group sb3 python experiments/parity_sb3.py --out tests/golden/sb3",
        "versions": {name: metadata.version(name) for name in packages},
        "order": order_of_events(),
    }
    (out / "versions.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    print(facts["order"])


if __name__ == "__main__":
    main()
