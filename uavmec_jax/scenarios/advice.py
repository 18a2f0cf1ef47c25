"""Advice on a user's scenario from a policy by name or file."""

from pathlib import Path

import jax

from uavmec_jax.planning.advice import Advice, advise
from uavmec_jax.scenarios.named_scenario import NamedScenario
from uavmec_jax.scenarios.policies import TrainedPolicy, load_policy


def advise_on(
    scenario: NamedScenario, policy: str | Path, *, samples: int, what_if: bool, seed: int = 0
) -> tuple[Advice, list[str]]:
    """Recommend the next visit, and warn of everything in which the scenario is unlike the policy's training.

    Args:
        scenario: the devices and their present state.
        policy: by name or from a file.
        samples: futures simulated for each candidate.
        what_if: whether to try every repair and removal too.
        seed: of the futures.

    Raises:
        PolicyError: no such policy, or one for another number of devices.
    """
    chosen = load_policy(policy)
    unlike = chosen.out_of_distribution(scenario.params, scenario.layout) if isinstance(chosen, TrainedPolicy) else []
    warnings = [f"{scenario.name}: {line}: {policy} may do worse here" for line in unlike]
    advice = advise(
        chosen,
        scenario.params,
        scenario.layout,
        scenario.state,
        key=jax.random.key(seed),
        samples=samples,
        what_if=what_if,
    )
    return advice, warnings
