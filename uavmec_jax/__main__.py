"""``python -m uavmec_jax`` is the command ``uavmec``."""

from uavmec_jax.cli import main

main(prog_name="uavmec")
