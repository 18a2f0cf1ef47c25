"""The environment for other libraries; each name imports the library that it is for when it is first used.

Importing this registers ``UavMec-v0`` with Gymnasium; ``gymnasium.make("uavmec_jax.interop:UavMec-v0")`` imports and makes it
at once. (Since Gymnasium 1.0, packages can no longer register environments without an import.)
"""

import importlib.util

import lazy_loader

ENV_ID = "UavMec-v0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

if importlib.util.find_spec("gymnasium"):
    import gymnasium

    if ENV_ID not in gymnasium.registry:
        gymnasium.register(
            ENV_ID,
            entry_point="uavmec_jax.interop.gymnasium_env:UavMecGymEnv",
            vector_entry_point="uavmec_jax.interop.vector_env:UavMecVectorEnv",
        )
