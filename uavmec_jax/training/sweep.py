"""Training for sweep scripts of one's own: any scenarios, any hyperparameters, one program."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import PRNGKeyArray

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.agents.registry import ALGORITHMS, Declaration
from uavmec_jax.env.rollout import Policy
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.errors import StudyError
from uavmec_jax.files.validation import nearest
from uavmec_jax.training import host, population
from uavmec_jax.training.partition import PopulationTooLargeError, plan_blocks
from uavmec_jax.training.population import Progress
from uavmec_jax.training.training import TrainedBlock, Validation


@dataclass(frozen=True)
class Trained:
    """A population that was trained.

    Attributes:
        algorithm: what trained it.
        hyper: the hyperparameters, leaves ``[A]``.
        block: weights and curves, leaves ``[A, ...]``.
    """

    algorithm: Algorithm
    hyper: Any
    block: TrainedBlock

    def policy(self, agent: int, which: str = "best") -> Policy:
        """The greedy policy of one agent: ``policy(params, layout, state, key=None) -> action``.

        Args:
            agent: its place in the population.
            which: ``best`` or ``last`` weights.
        """
        hyper, weights = jax.tree.map(lambda leaf: leaf[agent], (self.hyper, getattr(self.block, which)))
        return self.algorithm.policy(hyper, weights)

    def table(self) -> pd.DataFrame:
        """One row per agent: its hyperparameters, ``best_validation`` in slots, ``best_step``, ``diverged_at``."""
        hyper = {name: np.asarray(leaf) for name, leaf in vars(self.hyper).items()}
        return pd.DataFrame(
            hyper
            | {
                "best_validation": self.block.best_score,
                "best_step": self.block.best_step,
                "diverged_at": self.block.diverged_at,
            }
        )

    def curve_table(self) -> pd.DataFrame:
        """Tidy: ``agent``, ``steps``, ``validation`` (mean lifetime in slots) at every look."""
        n, looks = self.block.validation.shape
        return pd.DataFrame(
            {
                "agent": np.repeat(np.arange(n), looks),
                "steps": np.tile(self.block.look_steps, n),
                "validation": self.block.validation.ravel(),
            }
        )


def train(
    algorithm: str,
    scenarios: Scenario,
    *,
    key: PRNGKeyArray,
    steps: int,
    hyper: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
    validation: Validation | None = None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Trained:
    """Train one agent on each of ``A`` scenarios, all of them as one program.

    Args:
        algorithm: ``dqn``, ``ppo`` or ``a2c``.
        scenarios: leaves ``[A, ...]``, e.g. from ``jax.vmap(um.make_scenario)``; each may have its own layout,
            parameters and reward.
        key: of all randomness; agent ``i`` has the ``i``-th key split from it.
        steps: environment steps of one agent.
        hyper: traced hyperparameters, each a number or ``[A]`` of them.
        settings: what shapes the program: ``hidden``, ``batch_size``, ...
        validation: looks at the greedy policies, which choose the best weights.
        on_progress: told after every chunk.

    Raises:
        StudyError: no such algorithm, hyperparameter or setting; a length that does not fit; too little memory.
    """
    if algorithm not in ALGORITHMS:
        raise StudyError(f"algorithm is {algorithm!r}; {nearest(algorithm, ALGORITHMS)}")
    declared, validation = ALGORITHMS[algorithm], validation or Validation()
    n, n_devices = scenarios.layout.capacity.shape
    made = _bound(declared, settings or {}, steps, n_devices, int(np.max(scenarios.params.data_age_limit_slots)) + 1)
    spread = _spread(algorithm, declared, hyper or {}, n)
    training, looks = jax.random.split(key)
    agents = Agent(key=jax.random.split(training, n), scenario=scenarios, hyper=spread)
    try:
        blocks = plan_blocks(n, made.agent_bytes, host.free_memory())
    except PopulationTooLargeError as error:
        raise StudyError(f"steps is {steps}: {error}") from None
    draws = jax.random.split(looks, (n, validation.draws))
    trained = population.train(made, agents, draws, validation=validation, blocks=blocks, on_progress=on_progress)
    return Trained(made, spread, _whole(list(trained)))


def _bound(declared: Declaration, settings: Mapping[str, Any], steps: int, n_devices: int, max_age: int) -> Algorithm:
    """The algorithm with its static settings."""
    defaults = {name: getattr(declared.spec(), name) for name in declared.static}
    for name in settings:
        if name not in defaults:
            raise StudyError(f"settings has {name!r}; {nearest(name, defaults)}")
    try:
        return declared.make(defaults | dict(settings), total_steps=steps, n_devices=n_devices, max_age=max_age)
    except ValueError as error:
        raise StudyError(f"settings: {error}") from None


def _spread(algorithm: str, declared: Declaration, hyper: Mapping[str, Any], n: int) -> Any:
    """Every hyperparameter as ``[A]``."""
    for name in hyper:
        if name not in declared.traced:
            raise StudyError(f"hyper has {name!r}, which is not one of {algorithm}; {nearest(name, declared.traced)}")
    leaves = {}
    for name, value in vars(declared.hyper()).items():
        dtype = {bool: jnp.bool_, int: jnp.int32}.get(type(value), jnp.float32)
        given = jnp.asarray(hyper.get(name, value), dtype)
        if given.shape not in ((), (n,)):
            raise StudyError(f"hyper.{name} has shape {given.shape}; give one number or {n} of them, one per scenario")
        leaves[name] = jnp.broadcast_to(given, (n,))
    return declared.hyper(**leaves)


def _whole(blocks: list[TrainedBlock]) -> TrainedBlock:
    """Blocks one after the other; the steps of curves are shared by all, seconds add up."""
    parts = [vars(block) for block in blocks]
    shared = {name: parts[0][name] for name in ("chunk_steps", "look_steps")}
    seconds = {name: sum(part["seconds"][name] for part in parts) for name in parts[0]["seconds"]}
    joined = {
        name: jax.tree.map(lambda *leaves: np.concatenate(leaves), *(part[name] for part in parts))
        for name in parts[0]
        if name not in {*shared, "seconds"}
    }
    return TrainedBlock(**joined, **shared, seconds=seconds)
