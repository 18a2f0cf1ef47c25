"""The generalist's training over time, and whether it should imitate the beam first.

    uv run python experiments/generalist_training.py [--scenarios 3000] [--out results/generalist]

The study `generalist` is trained by PPO alone, and again after imitation of the clairvoyant beam: the beam plays drawn
scenarios, and the networks learn its actions (cross-entropy) and the slots that are left (squared error). At every validation
both are evaluated on unseen layouts of the 25 cells. For comparison, the paper's DQN is trained on each layout
(`results/table5`, at the speed of one agent alone, `results/benchmark`). Writes `training.json` and `training.png`.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from generalist_figures import training_figure
from jaxtyping import Array, Float, Int, Key
from reports import write_report

from uavmec_jax.agents.actor_critic import ActorCriticHyper, ActorCriticSpec, logits_and_value
from uavmec_jax.agents.gae import log_prob_and_entropy
from uavmec_jax.agents.optimizers import TrainState, apply_gradients, clipped_adam
from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.env.dynamics import initial_state
from uavmec_jax.env.generator import ScenarioDistribution, scenario_from_draw
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.rollout import rollouts, tour_policy, trace, volume_table
from uavmec_jax.planning.beam import WIDTH, beam_search
from uavmec_jax.planning.fleet_demand import longest, planned_slots
from uavmec_jax.planning.parallel import spread
from uavmec_jax.runs.results_folder import load_results
from uavmec_jax.runs.run_plan import plan_run
from uavmec_jax.studies.population import evaluation_keys, make_agents, make_algorithm, seeds_of, validation_keys
from uavmec_jax.studies.schema import Study
from uavmec_jax.studies.study import load_study
from uavmec_jax.training import host
from uavmec_jax.training.chunks import Validation
from uavmec_jax.training.training import Trainer, Training

_OPTIMIZER = clipped_adam(eps=1e-5)
_BATCH_SIZE = 1024
"""Of the imitation."""
_DEMONSTRATION_SEED = 20_000
"""Seed of the scenarios that the beam plays."""
_MAX_SLOTS = 64
"""Longest lifetime that the UAV's battery may pay for in a scenario that the beam plays."""

Evaluate = Callable[[Any], np.ndarray]
"""``evaluate(weights [seeds, ...]) -> [seeds]``, mean lifetime on unseen layouts, slots."""


class Demonstrations(NamedTuple):
    """Slots that the beam played, ``N`` of them.

    Attributes:
        observation: before each slot.
        action: the beam's.
        slots_left: that the network lives from this slot on.
    """

    observation: Float[np.ndarray, "N obs_size"]
    action: Int[np.ndarray, " N"]
    slots_left: Float[np.ndarray, " N"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", type=int, default=3000, help="that the beam plays")
    parser.add_argument("--epochs", type=int, default=20, help="passes over the beam's actions")
    parser.add_argument("--steps", type=int, help="environment steps of PPO (default: the study's)")
    parser.add_argument("--layouts", type=int, default=20, help="in each of the 25 cells")
    parser.add_argument("--out", type=Path, default=Path("results/generalist"))
    arguments = parser.parse_args()
    host.use_all_cores()

    changes = {"steps": arguments.steps} if arguments.steps else {}
    study = load_study("generalist", {"evaluation.validate_every": 250_000, **changes})
    evaluate, untrained = make_evaluation(study, arguments.layouts)
    trainer = compile_trainer(study)
    ppo = train(start(trainer, study), evaluate)

    tick = time.perf_counter()
    distribution = jax.tree.map(lambda leaf: leaf[0], make_agents(study).scenario)
    demonstrations = demonstrate(study, distribution, arguments.scenarios)
    beam_s = time.perf_counter() - tick
    seeds = len(seeds_of(study))
    weights = [imitate(study, demonstrations, seed, arguments.epochs) for seed in range(seeds)]
    imitation_s = time.perf_counter() - tick - beam_s
    slower = load_study("generalist", {"ppo.learning_rate": study.ppo.learning_rate / 3, **changes})
    pretrained = train(with_weights(start(trainer, slower), weights), evaluate, spent_s=beam_s + imitation_s)

    imitation_slots = evaluate(jax.tree.map(lambda *leaves: jnp.stack(leaves), *weights))
    n_actions = len(demonstrations.action)
    report = {
        "command": "uv run python experiments/generalist_training.py",
        "steps": study.steps,
        "seeds": seeds,
        "beam": {"scenarios": arguments.scenarios, "visits": n_actions, "seconds": round(beam_s, 1)},
        "imitation_seconds": round(imitation_s, 1),
        "imitation_slots": np.round(imitation_slots, 3).tolist(),
        "ppo": ppo.report(),
        "imitation_then_ppo": pretrained.report(),
        "towns": 25 * arguments.layouts,
        "lines": untrained,
        "dqn": paper_dqn(),
        **host.describe(),
    }
    write_report(arguments.out / "training.json", report)
    training_figure(report, arguments.out / "training.png")
    shown = ("beam", "imitation_seconds", "imitation_slots", "ppo", "imitation_then_ppo", "lines")
    print(json.dumps({name: report[name] for name in shown}, indent=1))


@dataclass
class Run:
    """The agents of a study in training.

    Attributes:
        training: the agents.
        seconds: of training and validation, at every validation.
        slots: ``[seeds]`` mean lifetime on unseen layouts, at every validation.
    """

    training: Training
    seconds: list[float] = field(default_factory=list)
    slots: list[np.ndarray] = field(default_factory=list)

    def report(self) -> dict[str, Any]:
        """Return the run as plain data."""
        return {
            "seconds": np.round(self.seconds, 1).tolist(),
            "slots": np.round(np.mean(self.slots, axis=1), 3).tolist(),
            "slots_by_seed": np.round(self.slots, 3).T.tolist(),
            "validation": np.round(np.stack(self.training.scores, 1), 3).tolist(),
            "best_validation": np.round(self.training.best_scores, 3).tolist(),
        }


def compile_trainer(study: Study) -> Trainer:
    """Compile the programs that train the agents of the study, whatever their learning rate."""
    algorithm, agents, keys = make_algorithm(study), make_agents(study), validation_keys(study)
    assert algorithm is not None
    settings, partition = study.evaluation, plan_run(study).partitions["ppo"]
    validation = Validation(every=settings.validate_every, draws=settings.validation_draws, chunks=1)
    return Trainer.compile(algorithm, agents, keys, validation, partition)


def start(trainer: Trainer, study: Study) -> Run:
    """Return the agents of the study before their first step."""
    return Run(trainer.start(make_agents(study), validation_keys(study)))


def train(run: Run, evaluate: Evaluate, spent_s: float = 0.0) -> Run:
    """Train to the end, with an evaluation at every validation.

    Args:
        run: before its first step.
        evaluate: its time does not count.
        spent_s: seconds spent before the training.
    """
    training = run.training
    for _ in training.run():
        run.seconds.append(spent_s + sum(training.seconds[name] for name in ("train", "validate")))
        weights = [jax.tree.map(np.asarray, batch.state.weights) for batch in training.group_batches]
        run.slots.append(evaluate(jax.tree.map(lambda *leaves: np.concatenate(leaves), *weights)))
    return run


def make_evaluation(study: Study, layouts: int) -> tuple[Evaluate, dict[str, float]]:
    """Return the evaluation on unseen layouts of the study `planning`, and mean lifetimes there without training."""
    planning = load_study("planning", {"axes.seeds": layouts})
    scenario, keys = make_agents(planning).scenario, evaluation_keys(planning)[:, :1]
    algorithm = make_algorithm(study)
    hyper = jax.tree.map(lambda leaf: leaf[0], make_agents(study).hyper)
    assert algorithm is not None

    @jax.jit
    def mean_lifetime(weights: Any) -> Float[Array, ""]:
        policy = algorithm.policy(hyper, weights)

        def lifetimes(params: Params, layout: Layout, keys: Key[Array, " D"]) -> Int[Array, " D"]:
            return rollouts(policy, params, layout, keys).length

        return jnp.mean(spread(lifetimes, scenario.params, scenario.layout, keys, batch=64).astype(jnp.float32))

    def evaluate(weights: Any) -> np.ndarray:
        seeds = jax.tree.leaves(weights)[0].shape[0]
        return np.array([float(mean_lifetime(jax.tree.map(lambda leaf, i=i: leaf[i], weights))) for i in range(seeds)])

    planned = load_results(Path("results/planning")).evaluation
    names = ("oldest_first", "earliest_deadline", "bound")
    return evaluate, {name: round(float(planned[f"{name}/lifetime"][: len(keys), 0].mean()), 3) for name in names}


def demonstrate(study: Study, distribution: ScenarioDistribution, count: int) -> Demonstrations:
    """Let the beam play ``count`` drawn scenarios."""
    keys = jax.random.split(jax.random.key(_DEMONSTRATION_SEED), 2 * count)
    scenarios = jax.jit(jax.vmap(partial(scenario_from_draw, distribution)))(keys)
    # A few drawn scenarios can last for hundreds of slots, for which the beam takes hours.
    short = np.flatnonzero(np.asarray(longest(scenarios.params, scenarios.layout)) <= _MAX_SLOTS)[:count]
    scenarios, keys = jax.tree.map(lambda leaf: leaf[short], (scenarios, keys))
    slots, observation_fn = (
        planned_slots(scenarios.params, scenarios.layout),
        spec_of(study).observation_spec.observation_fn,
    )

    def play(params: Params, layout: Layout, key: Key[Array, ""]) -> tuple[Array, ...]:
        volumes = volume_table(params, layout.capacity.shape[0], key, slots)
        tour = beam_search(params, layout, volumes, WIDTH)
        episode = trace(tour_policy(tour.actions), params, layout, key, slots)
        first = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], initial_state(params, layout))
        before = jax.tree.map(lambda start, leaf: jnp.concatenate([start, leaf[:-1]]), first, episode.state)
        observation = observation_fn(params, layout, before)
        return observation, episode.action, tour.lifetime - before.slot, episode.played

    results = jax.jit(lambda *arguments: spread(play, *arguments))(scenarios.params, scenarios.layout, keys)
    observation, action, slots_left, played = (np.asarray(leaf) for leaf in results)
    return Demonstrations(observation[played], action[played], slots_left[played].astype(np.float32))


def spec_of(study: Study) -> ActorCriticSpec:
    """Return the static settings of the study's PPO."""
    return ALGORITHMS["ppo"].spec_of(study.ppo.model_dump(), total_steps=study.steps, n_devices=study.params.n_devices)


def imitate(study: Study, demonstrations: Demonstrations, seed: int, epochs: int) -> Any:
    """Train weights for which the beam's actions are likely and state values are those of the study's reward."""
    spec, gamma = spec_of(study), study.ppo.gamma
    hyper = ActorCriticHyper(gamma=gamma)
    weights = spec.network.init(jax.random.key(seed), jnp.zeros((1, spec.obs_size)))
    observation, action, slots_left = (jnp.asarray(leaf) for leaf in demonstrations)
    returns = study.slot_reward * (1.0 - gamma**slots_left) / (1.0 - gamma)
    updates = max(epochs * len(action) // _BATCH_SIZE, 1)

    def loss_fn(weights: Any, batch: Int[Array, " b"]) -> Float[Array, ""]:
        logits, values = logits_and_value(spec, hyper, weights, observation[batch])
        log_prob, _ = log_prob_and_entropy(logits, action[batch])
        return -jnp.mean(log_prob) + 0.5 * jnp.mean(jnp.square(values - returns[batch]))

    def update(number: Int[Array, ""], train_state: TrainState) -> TrainState:
        batch = jax.random.randint(jax.random.fold_in(jax.random.key(seed), number), (_BATCH_SIZE,), 0, len(action))
        loss, gradient = jax.value_and_grad(loss_fn)(train_state.weights, batch)
        rate = study.ppo.learning_rate * 0.1 ** (number / updates)
        settings: dict[str, Any] = {"learning_rate": rate, "max_norm": 0.5, "count": number + 1, "steps_done": number}
        return apply_gradients(_OPTIMIZER, train_state, loss, gradient, **settings)

    initial = TrainState(weights, _OPTIMIZER.init(weights), jnp.int32(-1))
    return jax.jit(lambda train_state: jax.lax.fori_loop(0, updates, update, train_state))(initial).weights


def with_weights(run: Run, weights: list[Any]) -> Run:
    """Replace the weights that the agents start from, one set for each seed."""
    stacked, first = jax.tree.map(lambda *leaves: np.stack(leaves), *weights), 0
    for batch in run.training.group_batches:
        size = batch.state.diverged_at.shape[0]
        part = jax.tree.map(lambda leaf, first=first, size=size: leaf[first : first + size], stacked)
        placed = jax.tree.map(lambda new, old: jax.device_put(new, old.sharding), part, batch.state.weights)
        batch.state = replace(batch.state, weights=placed)
        first += size
    return run


def paper_dqn() -> dict[str, Any]:
    """Return validation lifetimes of the agents of `results/table5`, and the seconds that one of them takes alone."""
    curves = load_results(Path("results/table5")).curves["dqn"]
    rows = json.loads(Path("results/benchmark/benchmark_dqn.json").read_text(encoding="utf-8"))["training"]
    speed = next(row["steps_per_second"] for row in rows if row["agents"] == 1)
    chosen = np.unique(np.geomspace(1, len(curves["validation_steps"]), 12).astype(int)) - 1
    return {
        "seconds": np.round(curves["validation_steps"][chosen] / speed, 2).tolist(),
        "slots": np.round(curves["validation"][:, chosen].mean(axis=0), 3).tolist(),
        "towns": len(curves["validation"]),
    }


if __name__ == "__main__":
    main()
