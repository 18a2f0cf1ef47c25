"""The environment in pure JAX: parameters, hardware, layouts, dynamics, rewards, observation, rollouts, generator."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
