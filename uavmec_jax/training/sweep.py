"""``um.train``: train agents on any scenarios and with any hyperparameters, as one program."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import PRNGKeyArray

from uavmec_jax.agents.algorithm import Agent, Algorithm
from uavmec_jax.agents.registry import ALGORITHMS, MAX_STEPS, RegisteredAlgorithm, check_end
from uavmec_jax.agents.settings import SETTINGS
from uavmec_jax.cluster.connection import connected
from uavmec_jax.cluster.options import RayOptions
from uavmec_jax.env.checks import Bounds, Check, check_range, check_ranges
from uavmec_jax.env.layout import check_one_uav
from uavmec_jax.env.params import leaf_dtype
from uavmec_jax.env.rewards import check_reward
from uavmec_jax.env.rollout import Policy
from uavmec_jax.env.scenario import Scenario
from uavmec_jax.env.scenario_checks import check_scenario
from uavmec_jax.errors import ArgumentError, StudyError
from uavmec_jax.files.validation import suggest, validated
from uavmec_jax.training.chunks import Validation
from uavmec_jax.training.machine import Machine, probe_node
from uavmec_jax.training.on_ray import PopulationOnRay, ShardProgram
from uavmec_jax.training.partition import Partition, PopulationTooLargeError
from uavmec_jax.training.population import Progress, train_population
from uavmec_jax.training.trained_shard import TrainedShard


@dataclass(frozen=True)
class TrainedPopulation:
    """A trained population.

    Attributes:
        algorithm: the learning algorithm.
        hyper: the hyperparameters, leaves ``[A]``.
        result: weights and curves of all agents, leaves ``[A, ...]``.
    """

    algorithm: Algorithm
    hyper: Any
    result: TrainedShard

    def policy(self, agent: int, which: str = "best") -> Policy:
        """Return the greedy policy of one agent: ``policy(params, layout, state, key=None) -> action``.

        Args:
            agent: its index in the population.
            which: ``best`` for the weights with the best validation score, ``last`` for those after the last step.
        """
        hyper, weights = jax.tree.map(lambda leaf: leaf[agent], (self.hyper, getattr(self.result, which)))
        return self.algorithm.policy(hyper, weights)

    def table(self) -> pd.DataFrame:
        """Return one row per agent: its hyperparameters, ``best_validation`` (slots), ``best_step``, ``diverged_at``."""
        hyper = {name: np.asarray(leaf) for name, leaf in vars(self.hyper).items()}
        results = {
            "best_validation": self.result.best_score,
            "best_step": self.result.best_step,
            "diverged_at": self.result.diverged_at,
        }
        return pd.DataFrame(hyper | results)

    def curve_table(self) -> pd.DataFrame:
        """Return one row per agent and validation: ``agent``, ``steps``, ``validation`` (mean lifetime in slots)."""
        n, validations = self.result.validation.shape
        return pd.DataFrame(
            {
                "agent": np.repeat(np.arange(n), validations),
                "steps": np.tile(self.result.validation_steps, n),
                "validation": self.result.validation.ravel(),
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
    ray: RayOptions | str | bool | None = None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> TrainedPopulation:
    """Train one agent on each of ``A`` scenarios, all of them as one program.

    Args:
        algorithm: ``dqn``, ``pqn``, ``ppo`` or ``a2c``.
        scenarios: leaves ``[A, ...]``, e.g. from ``jax.vmap(um.make_scenario)``. Each scenario may have its own layout,
            parameters and reward.
        key: source of all randomness; agent ``i`` has the ``i``-th key split from it.
        steps: environment steps of one agent.
        hyper: traced hyperparameters, each one number or an array ``[A]``.
        settings: static settings: ``hidden``, ``batch_size``, ...
        validation: when and how to validate the greedy policies; the best score selects the best weights.
        ray: train the shards of the population on Ray: ``True`` for the cluster of ``RAY_ADDRESS``, else one on this
            machine; an address; or options. All nodes must have the same version of this package. A shard whose node dies
            begins again on another.
        on_progress: called after every chunk; on Ray, after every shard.

    Raises:
        ArgumentError: a number is out of range: the steps, a hyperparameter, the validation, or a value of a scenario;
            or the scenarios are not a batch.
        StudyError: an unknown algorithm, hyperparameter or setting, a wrong number of values, too little memory, several
            UAVs or depots, or a DQN on the paper's observation where episodes go on after a failure; on Ray, also if it
            is not installed or cannot be reached, a node has other code, or a shard failed.
    """
    if algorithm not in ALGORITHMS:
        raise StudyError(f"algorithm is {algorithm!r}; {suggest(algorithm, ALGORITHMS)}")
    check_range("steps", steps, ge=1, le=MAX_STEPS, whole=True)
    if np.ndim(scenarios.layout.capacity) != 2:
        shape = np.shape(scenarios.layout.capacity)
        raise ArgumentError(f"scenarios.layout.capacity has shape {shape}; it should be (scenarios, devices)")
    check_scenario(scenarios.params, scenarios.layout)
    check_reward(scenarios.reward)
    _check_scenarios(algorithm, scenarios, (settings or {}).get("observation", "paper"))
    registered, validation = ALGORITHMS[algorithm], validation or Validation()
    for name in ("every", "draws", "chunks"):
        check_range(f"validation.{name}", getattr(validation, name), ge=1, whole=True)
    n, n_devices = scenarios.layout.capacity.shape
    max_age = int(np.max(scenarios.params.data_age_limit_slots)) + 1
    bound = _bind(algorithm, settings or {}, steps, n_devices, max_age)
    batched_hyper = _batch_hyper(algorithm, registered, hyper or {}, n)
    training_key, validation_key = jax.random.split(key)
    agents = Agent(key=jax.random.split(training_key, n), scenario=scenarios, hyper=batched_hyper)
    draws = jax.random.split(validation_key, (n, validation.draws))
    with connected(RayOptions.of(ray)) as cluster:
        machine = probe_node(cluster) if cluster else Machine.here()
        try:
            partition = machine.partition(n, bound.agent_bytes)
        except PopulationTooLargeError as error:
            raise StudyError(f"steps is {steps}: {error}") from None
        if cluster:
            population = PopulationOnRay.of(cluster, ShardProgram.of(bound, validation, partition), agents, draws)
            results = population.train(on_shard=_shard_reporter(n, bound, partition, on_progress))
        else:
            results = list(
                train_population(
                    bound, agents, draws, validation=validation, partition=partition, on_progress=on_progress
                )
            )
    return TrainedPopulation(bound, batched_hyper, _concatenate(results))


def _shard_reporter(
    n: int, algorithm: Algorithm, partition: Partition, on_progress: Callable[[Progress], None]
) -> Callable[[int], None]:
    """Return a function that reports the progress of ``n`` agents when so many shards are finished."""

    def report(finished: int) -> None:
        agents = min(finished * partition.shard_size, n)
        steps = algorithm.total_steps
        on_progress(Progress(finished - 1, agents * steps, n * steps, float("nan")))

    return report


def _check_scenarios(algorithm: str, scenarios: Scenario, observation: str) -> None:
    """Check that an algorithm can train on scenarios."""
    try:
        check_one_uav(scenarios.layout, "training")
        check_end(algorithm, scenarios.params.end, observation)
    except ValueError as error:
        raise StudyError(str(error)) from None


def _bind(algorithm: str, settings: Mapping[str, Any], steps: int, n_devices: int, max_age: int) -> Algorithm:
    """Return the algorithm with its static settings bound; those not given have their defaults."""
    registered = ALGORITHMS[algorithm]
    defaults = {name: registered.defaults[name] for name in registered.static}
    for name in settings:
        if name not in defaults:
            raise StudyError(f"settings has {name!r}; {suggest(name, defaults)}")
    settings = {name: value.item() if isinstance(value, np.generic) else value for name, value in settings.items()}
    validated(SETTINGS[algorithm], settings, "settings", ArgumentError)
    try:
        return registered.make(defaults | dict(settings), total_steps=steps, n_devices=n_devices, max_age=max_age)
    except ValueError as error:
        raise StudyError(f"settings: {error}") from None


def _batch_hyper(algorithm: str, registered: RegisteredAlgorithm, hyper: Mapping[str, Any], n: int) -> Any:
    """Return the hyperparameters of ``n`` agents, leaves ``[A]``; those not given have their defaults."""
    for given in hyper:
        if given not in registered.traced:
            hint = suggest(given, registered.traced)
            raise StudyError(f"hyper has {given!r}, which is not a hyperparameter of {algorithm}; {hint}")
    leaves = {}
    for field in dataclasses.fields(registered.hyper):
        name = field.name
        default: Any = field.default
        bounds = Bounds(ge=0, le=1) if isinstance(default, bool) else Bounds.of(field)
        check_ranges([Check(f"hyper.{name}", hyper.get(name, default), bounds, ("agent",))])
        value = jnp.asarray(hyper.get(name, default), leaf_dtype(default))
        if value.shape not in ((), (n,)):
            raise StudyError(f"hyper.{name} has shape {value.shape}; give one number or {n} of them, one per scenario")
        leaves[name] = jnp.broadcast_to(value, (n,))
    return registered.hyper(**leaves)


def _concatenate(shards: list[TrainedShard]) -> TrainedShard:
    """Concatenate the results of shards; all share the steps of the curves, and their seconds are added."""
    fields = [vars(shard) for shard in shards]
    shared = {name: fields[0][name] for name in ("chunk_steps", "validation_steps")}
    seconds = {name: sum(shard.seconds[name] for shard in shards) for name in shards[0].seconds}
    concatenated = {
        name: jax.tree.map(lambda *leaves: np.concatenate(leaves), *(values[name] for values in fields))
        for name in fields[0]
        if name not in {*shared, "seconds"}
    }
    return TrainedShard(**concatenated, **shared, seconds=seconds)
