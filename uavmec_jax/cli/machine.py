"""Commands about the machine."""

import json

import click


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def doctor(as_json: bool) -> None:
    """Say versions, devices and memory, and check the speed for two seconds."""
    from uavmec_jax.training import host

    host.use_every_core()
    from uavmec_jax.runs.speed import environment_speed

    facts = host.describe() | {"environment_steps_per_second": round(environment_speed(seconds=2.0))}
    facts["versions"]["libsumo"] = host.version("libsumo")
    if as_json:
        click.echo(json.dumps(facts, indent=1))
        return
    for name, value in facts.items():
        if isinstance(value, dict):
            value = ", ".join(f"{key} {version}" for key, version in value.items())
        elif isinstance(value, list):
            value = ", ".join(value)
        click.echo(
            f"{name.replace('_', ' '):>30}  {value:,}"
            if isinstance(value, int)
            else f"{name.replace('_', ' '):>30}  {value}"
        )
