"""The environment for libraries that use Gymnasium or gymnax; importing this registers ``UavMec-v0`` with Gymnasium.

``gymnasium.make("uavmec_jax.interop:UavMec-v0")`` imports and makes it at once.
"""

import gymnasium

ENV_ID = "UavMec-v0"

if ENV_ID not in gymnasium.registry:
    gymnasium.register(
        ENV_ID,
        entry_point="uavmec_jax.interop.gymnasium_env:UavMecGymEnv",
        vector_entry_point="uavmec_jax.interop.vector_env:UavMecVectorEnv",
    )
