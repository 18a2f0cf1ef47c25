"""Make the population that a study describes: its agents, their scenarios and their volume draws."""

import itertools
import math
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.env.fleet import make_fleet
from uavmec_jax.env.generator import ScenarioDistribution
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params, leaf_dtype
from uavmec_jax.env.rewards import Reward, make_reward, needs_guard
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.scenarios.distribution import make_distribution
from uavmec_jax.scenarios.inventory import depots_of
from uavmec_jax.scenarios.seeds import Stream, identity_keys, layout_for_seed
from uavmec_jax.studies.axes import TRAFFIC_WEIGHTS
from uavmec_jax.studies.parts import split_study
from uavmec_jax.studies.places import move_to_places
from uavmec_jax.studies.schema import Study

AgentId = dict[str, Any]
"""Identity of one agent: its value on every axis of the study."""


def seeds_of(study: Study) -> list[int]:
    """Return the seeds of a study as a list."""
    seeds = study.axes["seeds"]
    return list(range(seeds)) if isinstance(seeds, int) else list(seeds)


def n_seeds(study: Study) -> int:
    """Return the number of seeds of a study without making them."""
    seeds = study.axes["seeds"]
    return seeds if isinstance(seeds, int) else len(seeds)


def n_clairvoyant_seeds(study: Study) -> int:
    """Return the number of seeds, from the first on, that beam and bound are evaluated on in one part of a study."""
    numbers = study.evaluation.clairvoyant_seeds
    return n_seeds(study) if numbers is None else min(n_seeds(study), numbers[min(study.uavs, len(numbers)) - 1])


def cell_axes(study: Study) -> list[str]:
    """Return the axes of a cell, which are all but the seeds; ``powered`` and ``connected``, or ``scenarios``, come first."""
    others = [name for name in study.axes if name not in ("powered", "connected", "cells", "seeds")]
    return [*(("scenarios",) if study.scenarios else ("powered", "connected")), *others]


def make_agent_ids(study: Study) -> list[AgentId]:
    """Return the identities of all agents.

    The axes of :data:`PART_AXES` are outermost, then come the seeds, so that the first shards hold whole grids. A reward
    without ``log A`` and ``log O`` is the same under every guard; it occurs once, under the first.
    """
    parts = split_study(study)
    if parts[0].values:
        order = ["seed", *cell_axes(study)]
        agent_ids = [agent_id | part.values for part in parts for agent_id in make_agent_ids(part.study)]
        return [{name: agent_id[name] for name in order} for agent_id in agent_ids]
    others = [name for name in cell_axes(study) if name in study.axes and name not in ("powered", "connected")]
    axes: list[Iterable[Any]] = [seeds_of(study), _cells(study), *(study.axes[name] for name in others)]
    agent_ids = [
        {"seed": seed} | cell | dict(zip(others, values, strict=True))
        for seed, cell, *values in itertools.product(*axes)
    ]
    return [agent_id for agent_id in agent_ids if not _repeats_earlier_guard(study, agent_id)]


def _cells(study: Study) -> list[AgentId]:
    """Return the cells by their numbers of powered and connected devices; one cell if scenarios are drawn."""
    if study.scenarios is not None:
        return [{"scenarios": "drawn"}]
    pairs = study.axes.get("cells") or itertools.product(study.axes["powered"], study.axes["connected"])
    return [{"powered": powered, "connected": connected} for powered, connected in pairs]


def _repeats_earlier_guard(study: Study, agent_id: AgentId) -> bool:
    """Return whether an agent is the same as one under the study's first guard."""
    if "guard" not in study.axes or agent_id["guard"] == study.axes["guard"][0]:
        return False
    return not needs_guard(agent_id.get("reward", study.reward))


def n_agents(study: Study) -> int:
    """Return the number of agents without making them."""
    others = [values for name, values in study.axes.items() if name not in ("seeds", "reward", "guard")]
    rewards, guards = study.axes.get("reward", [study.reward]), study.axes.get("guard", [study.guard])
    pairs = sum(len(guards) if needs_guard(reward) else 1 for reward in rewards)
    return math.prod(len(values) for values in others) * pairs * n_seeds(study)


def make_algorithm(study: Study) -> Algorithm | None:
    """Return the algorithm of a study of one algorithm, or ``None`` if the study trains nothing."""
    if study.algorithm == "none":
        return None
    limits = study.axes.get("data_age_limit_slots", [study.params.data_age_limit_slots])
    return ALGORITHMS[study.algorithm].make(
        getattr(study, study.algorithm).model_dump(),
        total_steps=study.steps,
        n_devices=study.params.n_devices,
        max_age=max(limits) + 1,
    )


def make_agents(study: Study, reward: Reward | None = None, agent_ids: list[AgentId] | None = None) -> Agent:
    """Make the agents of a study, leaves ``[A, ...]``.

    The randomness of an agent depends on its seed and its numbers of powered and connected devices alone: the layout on the
    seed (the cells of a seed have the same devices, fewer of them with power or communication), exploration and initial
    weights on all three. Hyperparameters, rewards, algorithms and fleets are thus compared under the same randomness.

    Args:
        study: one part of a study, see :func:`split_study`.
        reward: replaces the study's reward, for all agents.
        agent_ids: identities of the agents; by default all of the study, in the order of :func:`make_agent_ids`.
    """
    agent_ids = make_agent_ids(study) if agent_ids is None else agent_ids
    seeds, powered, connected = (_column(agent_ids, name) for name in ("seed", "powered", "connected"))
    params = Params(**{name: _stack(agent_ids, name, value) for name, value in study.params.model_dump().items()})
    rewards = _stack_rewards([_reward_of(study, agent_id, reward) for agent_id in agent_ids])
    scenario: Scenario | ScenarioDistribution
    if study.scenarios is None:
        layouts = move_to_places(_layouts_for_seeds(seeds, params, powered, connected), agent_ids, study)
        scenario = Scenario(params=params, layout=_add_fleets(layouts, params, study), reward=rewards)
    else:
        scenario = make_distribution(study.scenarios, params, rewards, len(agent_ids))
    algorithm = "dqn" if study.algorithm == "none" else study.algorithm  # "none" uses no hyperparameters
    registered, settings = ALGORITHMS[algorithm], getattr(study, algorithm)
    return Agent(
        key=identity_keys(Stream.TRAINING, seeds, powered, connected),
        scenario=scenario,
        hyper=registered.hyper(
            **{name: _stack(agent_ids, name, getattr(settings, name)) for name in registered.traced}
        ),
    )


def _stack(agent_ids: list[AgentId], name: str, default: Any) -> Any:
    """Return the values of a setting for all agents: leaves ``[A]``; a static setting as it is."""
    if isinstance(default, tuple):
        return tuple(jnp.full(len(agent_ids), number, jnp.float32) for number in default)
    if name == "n_devices" or isinstance(default, str):
        return default
    return jnp.asarray([agent_id.get(name, default) for agent_id in agent_ids], leaf_dtype(default))


def _reward_of(study: Study, agent_id: AgentId, reward: Reward | None) -> Reward:
    """Return the reward of one agent, the given one or the study's, with the agent's traffic weights."""
    if reward is None:
        reward = make_reward(agent_id.get("reward", study.reward), agent_id.get("guard", study.guard))
    traffic = {name: jnp.float32(agent_id.get(name, getattr(study, name))) for name in TRAFFIC_WEIGHTS}
    return replace(reward, per_slot=jnp.float32(study.slot_reward), **traffic)


def _stack_rewards(rewards: list[Reward]) -> Reward:
    """Return rewards as one, leaves ``[A, ...]``; where only some have the term of service, the others weigh it by 0."""
    if any(reward.service is not None for reward in rewards):
        rewards = [replace(reward, service=jnp.float32(reward.service or 0.0)) for reward in rewards]
    # stacked on the host: a program with one operand per agent takes minutes to compile
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack([np.asarray(leaf) for leaf in leaves])), *rewards)


def _add_fleets(layouts: Layout, params: Params, study: Study) -> Layout:
    """Give agents' layouts, leaves ``[A, ...]``, the UAVs and the depots of a part; one UAV without depots is no fleet."""
    position = np.array([(depot.x_m, depot.y_m) for depot in study.used_depots]).reshape(-1, 2)
    depots = depots_of(study.used_depots, position)
    if study.uavs == 1 and depots is None:
        return layouts
    fleets = jax.vmap(lambda params: make_fleet(params, study.uavs, depots))(params)
    agents = layouts.capacity.shape[0]
    depots = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (agents, *leaf.shape)), depots)
    return replace(layouts, fleet=fleets, depots=depots)


_layouts_for_seeds = jax.jit(jax.vmap(layout_for_seed))


def validation_keys(study: Study, agent_ids: list[AgentId] | None = None) -> Key[Array, "A D"]:
    """Return the volume draws of each agent's validations, ``validation_draws`` of them; by default for all agents."""
    return _draw_keys(study, Stream.VALIDATION, study.evaluation.validation_draws, agent_ids)


def evaluation_keys(study: Study, agent_ids: list[AgentId] | None = None) -> Key[Array, "A E"]:
    """Return the volume draws of each agent's evaluation; by default for all agents.

    They are the study's ``draws`` held-out draws, followed by the fixed draw, which is the same for every agent.
    """
    held_out = _draw_keys(study, Stream.HELD_OUT, study.evaluation.draws, agent_ids)
    fixed = jnp.broadcast_to(jax.random.key(Stream.FIXED), (held_out.shape[0], 1))
    return jnp.concatenate([held_out, fixed], axis=1)


def _draw_keys(study: Study, stream: Stream, draws: int, agent_ids: list[AgentId] | None) -> Key[Array, "A D"]:
    agent_ids = make_agent_ids(study) if agent_ids is None else agent_ids
    if study.scenarios is not None:  # all agents are evaluated on the same drawn scenarios
        agent_ids = [{"seed": 0}] * len(agent_ids)
    keys = identity_keys(stream, *(_column(agent_ids, name) for name in ("seed", "powered", "connected")))
    return _split(keys, draws)


@partial(jax.jit, static_argnames="n")
def _split(keys: Key[Array, " A"], n: int) -> Key[Array, "A D"]:
    return jax.vmap(lambda key: jax.random.split(key, n))(keys)


def _column(agent_ids: list[AgentId], name: str) -> Int[np.ndarray, " A"]:
    """Return one number of every identity; 0 if it has none, like the device counts of drawn scenarios."""
    return np.array([agent_id.get(name, 0) for agent_id in agent_ids], np.int32)
