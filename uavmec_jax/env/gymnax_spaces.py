"""The spaces of actions and observations as gymnax describes them. gymnax is not a dependency: only its clients ask."""

from typing import Any

import jax
import numpy as np

from uavmec_jax.env.layout import Layout
from uavmec_jax.env.observation import observation_bounds
from uavmec_jax.env.params import Params
from uavmec_jax.errors import UserError


def action_space(layout: Layout) -> Any:
    """Return a ``Discrete`` of the places that a UAV can fly to; for several UAVs a ``Tuple`` with one for each.

    Raises:
        UserError: gymnax is not installed.
    """
    spaces = _gymnax_spaces()
    if layout.n_uavs == 1:
        return spaces.Discrete(layout.n_places)
    return spaces.Tuple([spaces.Discrete(layout.n_places) for _ in range(layout.n_uavs)])


def paper_observation_space(params: Params, layout: Layout) -> Any:
    """Return the ``Box`` of the paper's observation.

    Raises:
        UserError: gymnax is not installed.
    """
    low, high = observation_bounds(params, layout.n_devices)
    return _gymnax_spaces().Box(low, high, low.shape, np.float32)


def unbounded_space(observation: Any) -> Any:
    """Return the space of an observation of which only the shapes are known.

    Args:
        observation: the array, or a dictionary, tuple or dataclass of such observations; ``jax.ShapeDtypeStruct`` will do.

    Returns:
        A ``Box`` without bounds for an array, a ``Dict`` for a dictionary, and a ``Tuple`` for all else.

    Raises:
        UserError: gymnax is not installed.
    """
    spaces = _gymnax_spaces()
    if isinstance(observation, dict):
        return spaces.Dict({name: unbounded_space(child) for name, child in observation.items()})
    if jax.tree_util.all_leaves([observation]):
        low = np.full(observation.shape, -np.inf, np.float32)
        return spaces.Box(low, -low, observation.shape, observation.dtype)
    children = jax.tree.leaves(observation, is_leaf=lambda node: node is not observation)
    return spaces.Tuple([unbounded_space(child) for child in children])


def _gymnax_spaces() -> Any:
    try:
        from gymnax.environments import spaces
    except ImportError as error:
        raise UserError(f"gymnax is not installed ({error}); install it: pip install gymnax") from None
    return spaces
