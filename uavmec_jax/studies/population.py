"""The population that a study describes: its agents, their scenarios and their draws."""

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.env.generator import ScenarioDistribution
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import Reward, make_reward, needs_guard
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.scenarios.distribution import make_distribution
from uavmec_jax.scenarios.seeds import _FIXED, _HELD_OUT, _TRAINING, _VALIDATION, _agent_keys, town
from uavmec_jax.studies.places import onto_places
from uavmec_jax.studies.schema import TRAFFIC_WEIGHTS, Study


def seeds_of(study: Study) -> list[int]:
    """The seeds as a list."""
    seeds = study.axes["seeds"]
    return list(range(seeds)) if isinstance(seeds, int) else list(seeds)


def cell_axes(study: Study) -> list[str]:
    """The axes that make a cell: all but the seeds, ``powered`` and ``connected`` (or ``scenarios``) first."""
    others = [name for name in study.axes if name not in ("powered", "connected", "cells", "seeds")]
    return [*(("scenarios",) if study.scenarios else ("powered", "connected")), *others]


def parts(study: Study) -> list[Study]:
    """The study cut into studies of one algorithm each, in the order in which they are run."""
    if "algorithm" not in study.axes:
        return [study]
    axes = {name: values for name, values in study.axes.items() if name != "algorithm"}
    return [study.model_copy(update={"algorithm": name, "axes": axes}) for name in study.axes["algorithm"]]


def identities(study: Study) -> list[dict[str, Any]]:
    """One dictionary per agent: its value on every axis. Algorithms outermost, then seeds: early blocks hold whole grids.

    A reward without ``log A`` and ``log O`` is the same under every guard and stands there once, under the first.
    """
    if "algorithm" in study.axes:
        order = ["seed", *cell_axes(study)]
        everyone = [who | {"algorithm": part.algorithm} for part in parts(study) for who in identities(part)]
        return [{name: who[name] for name in order} for who in everyone]
    others = [name for name in cell_axes(study) if name in study.axes and name not in ("powered", "connected")]
    axes: list[Iterable[Any]] = [seeds_of(study), _cells(study), *(study.axes[name] for name in others)]
    everyone = [
        {"seed": seed} | cell | dict(zip(others, values, strict=True))
        for seed, cell, *values in itertools.product(*axes)
    ]
    return [who for who in everyone if _says_something(study, who)]


def _cells(study: Study) -> list[dict[str, Any]]:
    """Counts of powered and connected devices; or that they are drawn."""
    if study.scenarios is not None:
        return [{"scenarios": "drawn"}]
    pairs = study.axes.get("cells") or itertools.product(study.axes["powered"], study.axes["connected"])
    return [{"powered": powered, "connected": connected} for powered, connected in pairs]


def _says_something(study: Study, who: Mapping[str, Any]) -> bool:
    """Whether an agent is not the same under an earlier guard."""
    if "guard" not in study.axes or who["guard"] == study.axes["guard"][0]:
        return True
    return needs_guard(who.get("reward", study.reward))


def n_agents(study: Study) -> int:
    """Size of the population, without making it."""
    others = [values for name, values in study.axes.items() if name not in ("seeds", "reward", "guard")]
    rewards, guards = study.axes.get("reward", [study.reward]), study.axes.get("guard", [study.guard])
    pairs = sum(len(guards) if needs_guard(reward) else 1 for reward in rewards)
    seeds = study.axes["seeds"]
    return math.prod(len(values) for values in others) * pairs * (seeds if isinstance(seeds, int) else len(seeds))


def make_algorithm(study: Study) -> Algorithm | None:
    """The algorithm of a study of one (see :func:`parts`) with its static settings; ``None`` if nothing is trained."""
    if study.algorithm == "none":
        return None
    limits = study.axes.get("data_age_limit_slots", [study.params.data_age_limit_slots])
    return ALGORITHMS[study.algorithm].make(
        getattr(study, study.algorithm).model_dump(),
        total_steps=study.steps,
        n_devices=study.params.n_devices,
        max_age=max(limits) + 1,
    )


Who = list[dict[str, Any]]
"""Agents by their identities."""


def make_agents(study: Study, reward: Reward | None = None, who: Who | None = None) -> Agent:
    """Agents of a study of one algorithm, leaves ``[A, ...]``; by default all, in the order of :func:`identities`.

    What is random about an agent hangs on its seed and its counts of devices alone: layouts on the seed (the cells of
    one seed are the same town with less and less power and communication), exploration and weights on all three.
    Hyperparameters, rewards and algorithms are thus compared on equal ground.

    Args:
        study: of one algorithm, or of none.
        reward: stands in for the study's reward, for all agents.
        who: some of the study's identities.
    """
    who = identities(study) if who is None else who
    seeds, powered, connected = (_column(who, name) for name in ("seed", "powered", "connected"))

    def leaf(name: str, default: Any) -> Any:
        dtype = {bool: jnp.bool_, int: jnp.int32}.get(type(default), jnp.float32)
        return jnp.asarray([agent.get(name, default) for agent in who], dtype)

    def spread(name: str, value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(jnp.full(len(who), part, jnp.float32) for part in value)
        return value if name == "n_devices" else leaf(name, value)

    settings: dict[str, Any] = {name: spread(name, value) for name, value in study.params.model_dump().items()}
    params = Params(**settings)
    rewards = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(_reward_of(study, agent, reward) for agent in who))
    plays: Scenario | ScenarioDistribution
    if study.scenarios is None:
        layout = onto_places(_towns(seeds, params, powered, connected), who, study)
        plays = Scenario(params=params, layout=layout, reward=rewards)
    else:
        plays = make_distribution(study.scenarios, params, rewards, len(who))
    declared = ALGORITHMS["dqn" if study.algorithm == "none" else study.algorithm]
    own = getattr(study, "dqn" if study.algorithm == "none" else study.algorithm)
    return Agent(
        key=_agent_keys(_TRAINING, seeds, powered, connected),
        scenario=plays,
        hyper=declared.hyper(**{name: leaf(name, getattr(own, name)) for name in declared.traced}),
    )


def _reward_of(study: Study, agent: Mapping[str, Any], reward: Reward | None) -> Reward:
    """The reward of one agent: the given one or the study's, with what traffic weighs in it."""
    if reward is None:
        reward = make_reward(agent.get("reward", study.reward), agent.get("guard", study.guard))
    traffic = {name: jnp.float32(agent.get(name, getattr(study, name))) for name in TRAFFIC_WEIGHTS}
    return replace(reward, per_slot=jnp.float32(study.slot_reward), **traffic)


_towns = jax.jit(jax.vmap(town))


def validation_keys(study: Study, who: Who | None = None) -> Any:
    """``[A, validation_draws]`` volume draws for the looks during training; by default of all agents."""
    return _draw_keys(study, _VALIDATION, study.evaluation.validation_draws, who)


def evaluation_keys(study: Study, who: Who | None = None) -> Any:
    """``[A, draws + 1]`` volume draws for the tables; the last one is the fixed draw, the same for every agent."""
    held_out = _draw_keys(study, _HELD_OUT, study.evaluation.draws, who)
    fixed = jnp.broadcast_to(jax.random.key(_FIXED), (held_out.shape[0], 1))
    return jnp.concatenate([held_out, fixed], axis=1)


def _draw_keys(study: Study, stream: int, draws: int, who: Who | None) -> Any:
    who = identities(study) if who is None else who
    if study.scenarios is not None:  # all agents are judged in the same scenarios
        who = [{"seed": 0}] * len(who)
    keys = _agent_keys(stream, *(_column(who, name) for name in ("seed", "powered", "connected")))
    return _split(keys, draws)


@partial(jax.jit, static_argnames="n")
def _split(keys: Any, n: int) -> Any:
    return jax.vmap(lambda key: jax.random.split(key, n))(keys)


def _column(who: Who, name: str) -> np.ndarray:
    """One number of every agent's identity; 0 where it has none: drawn scenarios have no counts of devices."""
    return np.array([agent.get(name, 0) for agent in who], np.int32)
