"""Judge policies: every one plays the same layouts and the same volume draws through the same rollout."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from uavmec_jax.learning.algorithm import Agent, Algorithm
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.world.physics import Cause
from uavmec_jax.world.rollout import Episode, rollouts


@dataclass(frozen=True)
class Judgement:
    """How one policy did on ``A`` agents' scenarios; ``D`` held-out draws and the fixed one behind them.

    Attributes:
        lifetime: ``[A, D + 1]`` int32 slots.
        cause: ``[A, D + 1]`` int8, a :class:`Cause`.
        first_failure: ``[A, D + 1, n]`` f32, share of each device in the first failure of each episode.
    """

    lifetime: np.ndarray
    cause: np.ndarray
    first_failure: np.ndarray

    @property
    def mean_lifetime(self) -> np.ndarray:
        """``[A]`` mean over the held-out draws."""
        return self.lifetime[:, :-1].mean(axis=1)

    @property
    def often_first(self) -> np.ndarray:
        """``[A, n]`` how often each device is the first to fail, over the held-out draws."""
        return self.first_failure[:, :-1].mean(axis=1)

    def columns(self, policy: str) -> dict[str, Any]:
        """The judgement as columns of the tidy table, named after the policy."""
        prefix = policy.replace("-", "_")
        often = self.often_first
        fixed = self.first_failure[:, -1]
        return {
            f"{prefix}_lifetime": self.mean_lifetime,
            f"{prefix}_lifetime_fixed": self.lifetime[:, -1],
            f"{prefix}_cause": [_commonest(causes) for causes in self.cause[:, :-1]],
            f"{prefix}_cause_fixed": [Cause(cause).name.lower() for cause in self.cause[:, -1]],
            f"{prefix}_first_device": [_device(row) for row in often],
            f"{prefix}_first_share": often.max(axis=1),
            f"{prefix}_first_devices_fixed": [" ".join(str(i + 1) for i in np.flatnonzero(row)) for row in fixed],
        }


def _commonest(causes: np.ndarray) -> str:
    return Cause(int(np.bincount(causes).argmax())).name.lower()


def _device(share: np.ndarray) -> int:
    """Number (from 1) of the device that is first most often; 0 if none ever fails."""
    return int(share.argmax()) + 1 if share.max() > 0 else 0


def judge(
    algorithm: Algorithm,
    agents: Agent,
    keys: Key[Array, "A D"],
    weights: Mapping[str, Any],
    baselines: Iterable[str],
) -> dict[str, Judgement]:
    """Play every policy on every agent's scenario.

    Args:
        algorithm: makes policies from weights.
        agents: leaves ``[A, ...]``.
        keys: ``[A, D + 1]`` volume draws, from :func:`uavmec_jax.studies.study.evaluation_keys`.
        weights: name -> trained weights, leaves ``[A, ...]``.
        baselines: names in :data:`HEURISTICS`.
    """
    episodes = {name: _play_learned(algorithm, agents, keys, trained) for name, trained in weights.items()}
    episodes |= _play_baselines(tuple(baselines), agents, keys)
    return {
        name: Judgement(
            lifetime=np.asarray(episode.length),
            cause=np.asarray(episode.cause, np.int8),
            first_failure=np.asarray(episode.first_failure),
        )
        for name, episode in episodes.items()
    }


# Jitted here and not inside `judge`, so that the blocks of a run share one compilation.
@partial(jax.jit, static_argnames="algorithm")
def _play_learned(algorithm: Algorithm, agents: Agent, keys: Key[Array, "A D"], weights: Any) -> Episode:
    def one(agent: Agent, draws: Key[Array, " D"], weights: Any) -> Episode:
        policy = algorithm.policy(agent.hyper, weights)
        return rollouts(policy, agent.scenario.params, agent.scenario.layout, draws)

    return jax.vmap(one)(agents, keys, weights)


@partial(jax.jit, static_argnames="names")
def _play_baselines(names: tuple[str, ...], agents: Agent, keys: Key[Array, "A D"]) -> dict[str, Episode]:
    def one(agent: Agent, draws: Key[Array, " D"]) -> dict[str, Episode]:
        world = (agent.scenario.params, agent.scenario.layout, draws)
        return {name: rollouts(HEURISTICS[name], *world) for name in names}

    return jax.vmap(one)(agents, keys)
