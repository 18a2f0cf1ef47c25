"""Presets for users who want the best learner without choosing settings: keywords for :func:`uavmec_jax.train`."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

DQN_BEST: Mapping[str, Any] = MappingProxyType({"algorithm": "pqn", "steps": 1_200_000, "hyper": {}, "settings": {}})
"""The best Q-learner there is, that of the study `table5-best`: PQN with its defaults, 1,200,000 steps.

``um.train(scenarios=scenarios, key=key, **um.DQN_BEST)``; the scenarios should pay one per slot,
``um.make_scenario(layout, reward=um.make_reward({}, per_slot=1.0))``.
"""
