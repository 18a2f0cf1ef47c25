"""Commands about the machine."""

import click

from uavmec_jax.cli.common import print_json, print_line
from uavmec_jax.cli.options import json_option


@click.command()
@json_option
def doctor(as_json: bool) -> None:
    """Print versions, devices and memory, and measure the speed of the environment for two seconds."""
    from uavmec_jax.training import host

    host.use_all_cores()
    from uavmec_jax.training.environment_speed import environment_speed

    facts = host.describe() | {"environment_steps_per_second": round(environment_speed(seconds=2.0))}
    facts["versions"]["libsumo"] = host.version("libsumo")
    if as_json:
        print_json(facts)
        return
    for name, value in facts.items():
        if isinstance(value, dict):
            value = ", ".join(f"{key} {version}" for key, version in value.items())
        elif isinstance(value, list):
            value = ", ".join(value)
        elif isinstance(value, int):
            value = f"{value:,}"
        print_line(f"{name.replace('_', ' '):>30}  {value}")
