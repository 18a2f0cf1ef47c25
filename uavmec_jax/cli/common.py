"""Shared by the commands: errors in one line, settings from the command line, tables on the terminal."""

import json
import sys
import time
import tomllib
from pathlib import Path
from typing import IO, Any

import click

_EXAMPLES = {"--set": "--set dqn.gamma=0.99", "--resource": "--resource bigmem=1"}


class InputError(click.ClickException):
    """Wrong input: the message is printed in one line on standard error; the exit code is 2."""

    exit_code = 2

    def show(self, file: IO[Any] | None = None) -> None:
        """Print the line."""
        click.echo(f"uavmec: {' '.join(self.message.split())}", file=file, err=file is None)


class Interrupt(click.ClickException):
    """A signal ended the command; the exit code is 128 + the signal's number, as shells expect."""

    def __init__(self, message: str, signal: int) -> None:
        """Make the exception; ``message`` says how to continue."""
        super().__init__(message)
        self.exit_code: int = 128 + signal  # type: ignore[misc]

    def show(self, file: IO[Any] | None = None) -> None:
        """Print the line."""
        click.echo(f"interrupted: {self.message}", file=file, err=file is None)


def assignment(text: str, option: str = "--set") -> tuple[str, Any]:
    """Parse ``NAME=VALUE``, with the value as in TOML; a bare word is a string.

    Raises:
        InputError: the equals sign or the name is missing.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise InputError(f"{option} {text}: give NAME=VALUE, e.g. {_EXAMPLES.get(option, 'algorithm=dqn')}")
    try:
        return name.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return name.strip(), value.strip()


def print_json(data: Any) -> None:
    """Print plain data as JSON on standard output."""
    click.echo(json.dumps(data, indent=1))


def print_results(results: Any, directory: Path, console: Any, as_json: bool, status: Any = None) -> None:
    """Print the tables of a run, and its status if that is given; as JSON, its label, its cells and its status."""
    from uavmec_jax.reporting.status import status_lines
    from uavmec_jax.reporting.summary import summary
    from uavmec_jax.reporting.tables import tables
    from uavmec_jax.studies.first_failures import place_frames

    if as_json:
        data = {"directory": str(directory), "run": results.run}
        data |= {} if status is None else {"status": status.as_json()}
        for name, table in {"cells": results.cells(), **place_frames(results)}.items():
            data[name] = json.loads(table.to_json(orient="records"))
        print_json(data)
        return
    lines = [] if status is None else [f"{results.study.name}, a run that is not complete", *status_lines(status)]
    print_tables(console, tables(results), [*summary(results), *lines], directory)


def print_tables(console: Any, tables: dict[str, Any], lines: list[str], directory: Path | None = None) -> None:
    """Print tables with their titles, lines below them, and the folder of the files."""
    for title, table in tables.items():
        console.print(f"[bold]{title}[/bold]")
        console.print(table)
    for line in lines:
        console.print(line, highlight=False, markup=False)
    if directory is not None:
        console.print(f"Files: {directory}", highlight=False, markup=False, soft_wrap=True)


def new_folder(name: str) -> Path:
    """Return the default folder of a run, a search or a tour."""
    return Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"


def command_line() -> str:
    """Return the command line, for the labels of results."""
    return " ".join(["uavmec", *sys.argv[1:]])
