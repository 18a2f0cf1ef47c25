"""Shared by the commands: errors in one line, settings from the command line, tables on the terminal."""

import functools
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


def print_results(results: Any, directory: Path, console: Any, as_json: bool) -> None:
    """Print the tables of a run; as JSON, its label and its cells."""
    from uavmec_jax.reporting.summary import summary
    from uavmec_jax.reporting.tables import tables
    from uavmec_jax.studies.first_failures import place_frames

    if as_json:
        data = {"directory": str(directory), "run": results.run}
        for name, table in {"cells": results.cells(), **place_frames(results)}.items():
            data[name] = json.loads(table.to_json(orient="records"))
        print_json(data)
        return
    print_tables(console, tables(results), summary(results), directory)


def print_tables(console: Any, tables: dict[str, Any], lines: list[str], directory: Path | None = None) -> None:
    """Print tables with their titles, lines below them, and the folder of the files."""
    for title, table in tables.items():
        console.print(f"[bold]{title}[/bold]")
        console.print(table)
    for line in lines:
        console.print(line, highlight=False)
    if directory is not None:
        console.print(f"Files: {directory}", highlight=False, soft_wrap=True)


def new_folder(name: str) -> Path:
    """Create the default folder of a run, a search or a tour; the end of the command removes it if it is still empty."""
    from uavmec_jax.files.output_folders import create_new_folder, remove_if_empty

    runs = Path("runs")
    created = [] if runs.exists() else [runs]
    folder = create_new_folder(runs, f"{name}-{time.strftime('%Y%m%d-%H%M%S')}")
    for path in (*created, folder):  # the last one is called first
        click.get_current_context().call_on_close(functools.partial(remove_if_empty, path))
    return folder


def command_line() -> str:
    """Return the command line, for the labels of results."""
    return " ".join(["uavmec", *sys.argv[1:]])
