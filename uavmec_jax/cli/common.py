"""What the commands share: one line for a mistake, settings from the command line, tables on the terminal."""

import json
import sys
import time
import tomllib
from pathlib import Path
from typing import Any, NoReturn

import click

_EXAMPLES = {"--set": "--set dqn.gamma=0.99"}


def assignment(text: str, option: str = "--set") -> tuple[str, Any]:
    """``name=value`` with the value as in TOML; a bare word is a string."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        fail(f"{option} {text}: give NAME=VALUE, e.g. {_EXAMPLES.get(option, 'algorithm=dqn')}")
    try:
        return name.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return name.strip(), value.strip()


def print_results(results: Any, directory: Path, console: Any, as_json: bool) -> None:
    """The tables of a run, or its cells as JSON."""
    from uavmec_jax.reporting.tables import summary, tables
    from uavmec_jax.studies.first_failures import place_frames

    if as_json:
        told = {"directory": str(directory), "run": results.run}
        for name, table in {"cells": results.cells(), **place_frames(results)}.items():
            told[name] = json.loads(table.to_json(orient="records"))
        click.echo(json.dumps(told, indent=1))
        return
    print_tables(console, tables(results), summary(results), directory)


def print_tables(console: Any, tables: dict[str, Any], lines: list[str], directory: Path | None = None) -> None:
    """Titled tables, lines below them, and where the files are."""
    for title, table in tables.items():
        console.print(f"[bold]{title}[/bold]")
        console.print(table)
    for line in lines:
        console.print(line, highlight=False)
    if directory is not None:
        console.print(f"Files: {directory}", highlight=False, soft_wrap=True)


def new_folder(name: str) -> Path:
    """Where a run or a plan goes unless the user says where."""
    return Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"


def command_line() -> str:
    """The command as it was given, for the labels of results."""
    return " ".join(["uavmec", *sys.argv[1:]])


def fail(message: object) -> NoReturn:
    """One line on standard error, exit code 2."""
    click.echo(f"uavmec: {' '.join(str(message).split())}", err=True)
    sys.exit(2)
