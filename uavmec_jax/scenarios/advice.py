"""Advice on a user's scenario from a policy by name or file."""

from pathlib import Path

import jax

from uavmec_jax.planning.advice import Advice, advise
from uavmec_jax.planning.fleet_demand import is_alone
from uavmec_jax.scenarios.named_scenario import NamedScenario
from uavmec_jax.scenarios.policies import TrainedPolicy, load_policy


def default_policy(scenario: NamedScenario) -> str:
    """Return the name of the policy to follow if none is named: one that was trained only for what it was trained on."""
    return "generalist" if is_alone(scenario.layout) else "earliest-deadline"


def advise_on(
    scenario: NamedScenario, policy: str | Path, *, samples: int, what_if: bool, seed: int = 0
) -> tuple[Advice, list[str]]:
    """Recommend the next visits, and warn where the scenario lies outside the policy's training distribution.

    Args:
        scenario: the devices and their present state.
        policy: name of a policy, or its file.
        samples: number of futures simulated for each candidate.
        what_if: whether to evaluate every repair and removal of a device too.
        seed: seed of the futures.

    Raises:
        PolicyError: there is no such policy, or it was trained for another number of devices.
    """
    loaded = load_policy(policy)
    warnings = []
    if isinstance(loaded, TrainedPolicy):
        differences = loaded.out_of_distribution(scenario.params, scenario.layout)
        warnings = [f"{scenario.name}: {difference}: {policy} may do worse here" for difference in differences]
        warnings += [f"{scenario.name}: {line}" for line in loaded.fleet_warnings(scenario.layout)]
    advice = advise(
        loaded,
        scenario.params,
        scenario.layout,
        scenario.state,
        key=jax.random.key(seed),
        samples=samples,
        what_if=what_if,
    )
    return advice, warnings
