"""The names under which Gymnasium knows the environment."""

ENV_ID = "UavMec-v0"


def register() -> None:
    """Register ``UavMec-v0`` with Gymnasium, once. Gymnasium does so by itself where the package is installed."""
    import gymnasium

    if ENV_ID not in gymnasium.registry:
        gymnasium.register(
            ENV_ID,
            entry_point="uavmec_jax.interop.gymnasium_env:UavMecGymEnv",
            vector_entry_point="uavmec_jax.interop.vector_env:UavMecVectorEnv",
        )
