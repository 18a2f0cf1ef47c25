"""What both of Gymnasium's environments are made with: the scenario by its parts, and the observation by its name."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from uavmec_jax.agents.observation_spec import OBSERVATIONS
from uavmec_jax.env.checks import check_range
from uavmec_jax.env.layout import check_one_uav, sample_layout
from uavmec_jax.env.observation import observation_bounds
from uavmec_jax.env.params import Params
from uavmec_jax.env.rewards import DEFAULT_REWARD, Reward, make_reward
from uavmec_jax.env.scenario import Scenario, make_scenario
from uavmec_jax.errors import ArgumentError
from uavmec_jax.scenarios.load import load_scenario


def choose_scenario(
    scenario: Scenario | str | Path | None,
    powered: int | None,
    connected: int | None,
    layout_seed: int | None,
    reward: str | Reward | None,
    batch: int | None = None,
) -> Scenario:
    """Return the scenario that options describe.

    Args:
        scenario: a scenario, or a scenario file; ``None`` for random layouts of the paper's twelve devices.
        powered: number of devices with power in random layouts; ``None``: 8.
        connected: number of devices with communication in random layouts; ``None``: 8.
        layout_seed: seed of the random layout, or of the first one; ``None``: 0.
        reward: a name of Table 6, or a reward; ``None`` for that of the scenario, or the one that the paper found best.
        batch: number of scenarios, leaves ``[batch, ...]``: random layouts that all differ, else one for all or one each;
            ``None`` for one without that axis.

    Raises:
        ValueError: the scenario is a batch of another size.
        ScenarioError: the file is not usable.
        ArgumentError: an option is out of range, or does not go with a scenario; one line.
    """
    random_options = {"powered": powered, "connected": connected, "layout_seed": layout_seed}
    given = [name for name, value in random_options.items() if value is not None]
    if scenario is None:
        chosen = _random_scenario(powered, connected, layout_seed, batch)
    elif given:
        raise ArgumentError(f"{given[0]} is for random layouts, and a scenario is given; leave one of them out")
    elif isinstance(scenario, str | Path):
        named = load_scenario(scenario)
        chosen = make_scenario(named.layout, named.params)
    else:
        chosen = scenario
    if reward is not None:
        made = make_reward(reward) if isinstance(reward, str) else reward
        chosen = replace(chosen, reward=_repeated(made, chosen.layout.capacity.shape[:-1]))
    return chosen if batch is None else _batched(chosen, batch)


def _batched(scenario: Scenario, batch: int) -> Scenario:
    """Return ``batch`` scenarios, leaves ``[batch, ...]``."""
    if scenario.layout.capacity.ndim == 1:
        return _repeated(scenario, (batch,))
    if scenario.layout.capacity.shape[0] != batch:
        raise ValueError(f"scenario holds {scenario.layout.capacity.shape[0]} layouts; it should hold {batch}")
    return scenario


def _repeated(tree: Any, shape: tuple[int, ...]) -> Any:
    """Return a pytree with batch axes of that shape in front of every leaf."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*shape, *jnp.shape(leaf))), tree)


def _random_scenario(powered: int | None, connected: int | None, seed: int | None, batch: int | None) -> Scenario:
    """Return random layouts of the paper's devices."""
    params, most = Params(), Params.n_devices
    powered, connected = (2 * most // 3 if count is None else count for count in (powered, connected))
    seed = 0 if seed is None else seed
    check_range("powered", powered, ge=0, le=most, whole=True)
    check_range("connected", connected, ge=0, le=most, whole=True)
    check_range("layout_seed", seed, ge=0, le=2**31 - 1 - (batch or 0), whole=True)
    reward = make_reward(DEFAULT_REWARD)

    def sample(number: Array) -> Scenario:
        layout = sample_layout(jax.random.key(number), params, powered, connected)
        return make_scenario(layout, params, reward)

    return sample(jnp.int32(seed)) if batch is None else jax.vmap(sample)(seed + jnp.arange(batch))


def choose_spaces(scenario: Scenario, observation: str) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Discrete]:
    """Return the spaces of observations and actions of a scenario, or of one of a batch.

    The action is the device to visit. The paper's observation is ``[2n]``, see :func:`um.env.observe`; the full one
    ``[n * (F + 1)]``: device after device, each with the features of :data:`um.planning.FEATURES` and then a 1, or a 0 for
    padding.

    Raises:
        ValueError: the layout has several UAVs or depots.
        ArgumentError: the observation is unknown.
    """
    check_one_uav(scenario.layout, "this interface")
    if observation not in OBSERVATIONS:
        raise ArgumentError(f"observation is {observation!r}; it should be {' or '.join(map(repr, OBSERVATIONS))}")
    spec, n = OBSERVATIONS[observation], scenario.layout.n_devices
    if observation == "paper":
        low, high = observation_bounds(scenario.params, n)
    else:
        high = np.full(spec.obs_size(n), np.inf, np.float32)
        low = -high
    return gymnasium.spaces.Box(low, high, dtype=np.float32), gymnasium.spaces.Discrete(n)
