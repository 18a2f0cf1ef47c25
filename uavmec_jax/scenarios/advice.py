"""A scene: one's own devices where they stand now, and advice about them."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from uavmec_jax.env.dynamics import State, initial_state
from uavmec_jax.env.layout import Layout
from uavmec_jax.errors import StateError
from uavmec_jax.planning.advice import Advice, advise
from uavmec_jax.scenarios.load import load_scenario
from uavmec_jax.scenarios.named_scenario import Inventory
from uavmec_jax.scenarios.policies import TrainedPolicy, load_policy
from uavmec_jax.scenarios.state_files import load_state, state_data


@dataclass(frozen=True)
class Scene:
    """Devices and where they stand.

    Attributes:
        inventory: the devices, with their names.
        state: batteries, ages, UAV.
        price: see :class:`uavmec_jax.Traffic`; ``None``: as the layout has it.
    """

    inventory: Inventory
    state: State
    price: float | None = None

    @property
    def layout(self) -> Layout:
        """The devices, with the price."""
        layout = self.inventory.layout
        if self.price is None or layout.traffic is None:
            return layout
        return replace(layout, traffic=replace(layout.traffic, price=np.float32(self.price)))

    def state_data(self) -> dict[str, Any]:
        """The state as a state file holds it."""
        return state_data(self.state, self.inventory)


def load_scene(layout: Path | None, state: Path | None = None, *, price: float | None = None, **scenario: Any) -> Scene:
    """The devices of a layout file, or of a random town, in the state that a file says, or at the beginning.

    Args:
        layout: a layout file; ``None``: a random town.
        state: a state file.
        price: slots of life that a first failure in the densest traffic costs.
        scenario: as :func:`uavmec_jax.scenarios.load.load_scenario` takes them.

    Raises:
        LayoutError, TrafficError, StudyError: see there.
        StateError: the state does not fit, or a price is given where no traffic is known.
    """
    inventory, _ = load_scenario(layout, **scenario)
    if price is not None:
        if not 0 <= price < np.inf:
            raise StateError(f"--price is {price}; give slots, a finite number from 0")
        if inventory.layout.traffic is None:
            raise StateError(
                "--price is given, but nobody knows the traffic of these devices; give --place, e.g. albany"
            )
    start = initial_state(inventory.params, inventory.layout)
    return Scene(inventory, start if state is None else load_state(state, inventory), price)


def advise_at(
    scene: Scene, policy: str | Path, *, samples: int, what_if: bool, seed: int = 0
) -> tuple[Advice, list[str]]:
    """Advice for a scene, and a line for everything in which it is unlike what the policy was trained on.

    Raises:
        PolicyError: no such policy, or one for another number of devices.
    """
    chosen = load_policy(policy)
    params, layout = scene.inventory.params, scene.layout
    found = chosen.unlike_training(params, layout) if isinstance(chosen, TrainedPolicy) else []
    warnings = [f"{scene.inventory.file.name}: {line}: {policy} may do worse here" for line in found]
    key = jax.random.key(seed)
    return advise(chosen, params, layout, scene.state, key=key, samples=samples, what_if=what_if), warnings
