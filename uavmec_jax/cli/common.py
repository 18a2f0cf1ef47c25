"""Shared by the commands: errors in one line, settings from the command line, tables on the terminal."""

import functools
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import click

from uavmec_jax.errors import UserError, one_line
from uavmec_jax.files.parsing import parse_value

_EXAMPLES = {"--set": "--set dqn.gamma=0.99", "--resource": "--resource bigmem=1"}

_MAX_NAME = 200
"""Characters of a setting's name."""


class InputError(click.ClickException):
    """Wrong input: the message is printed in one line on standard error; the exit code is 2."""

    exit_code = 2

    def show(self, file: IO[Any] | None = None) -> None:
        """Print the line."""
        click.echo(one_line(f"uavmec: {self.message}"), file or sys.stderr)


class Interrupt(click.ClickException):
    """A signal ended the command; the exit code is 128 + the signal's number, as shells expect."""

    def __init__(self, message: str, signal: int) -> None:
        """Make the exception; ``message`` says how to continue."""
        super().__init__(message)
        self.exit_code: int = 128 + signal  # type: ignore[misc]

    def show(self, file: IO[Any] | None = None) -> None:
        """Print the line."""
        click.echo(one_line(f"interrupted: {self.message}"), file or sys.stderr)


def is_utf8(text: str) -> bool:
    """Return whether a text of the command line is UTF-8: Python stands surrogates for bytes that are not."""
    return not any("\ud800" <= letter <= "\udfff" for letter in text)


def assignment(text: str, option: str = "--set") -> tuple[str, Any]:
    """Parse ``NAME=VALUE``, with the value as in TOML; a bare word is a string.

    Raises:
        InputError: the equals sign or the name is missing, or the value is longer or deeper than any setting.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise InputError(f"{option} {text}: give NAME=VALUE, e.g. {_EXAMPLES.get(option, 'algorithm=dqn')}")
    if not is_utf8(text):
        raise InputError(f"{option} {text}: holds bytes that are not UTF-8; give it in UTF-8")
    if len(name) > _MAX_NAME:
        raise InputError(f"{option} {text}: is too long; a name has at most {_MAX_NAME} characters")
    try:
        return name.strip(), parse_value(value)
    except UserError as error:
        raise InputError(f"{option} {name.strip()}: {error}") from None


def assignments(texts: Sequence[str], option: str = "--set") -> dict[str, Any]:
    """Parse an option that is given several times, as :func:`assignment`.

    Raises:
        InputError: as there, or a name is given twice.
    """
    values: dict[str, Any] = {}
    for name, value in (assignment(text, option) for text in texts):
        if name in values:
            raise InputError(f"{option} {name}: is given twice; give it once")
        values[name] = value
    return values


def print_line(text: str, *, err: bool = False) -> None:
    """Print text on standard output or standard error, in their encoding: click would change ASCII to UTF-8."""
    click.echo(text, sys.stderr if err else sys.stdout)


def warn(line: str) -> None:
    """Print a warning on standard error."""
    print_line(one_line(f"uavmec: warning: {line}"), err=True)


def print_json(data: Any) -> None:
    """Print plain data as JSON on standard output."""
    print_line(json.dumps(data, indent=1))


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
        console.print(title, style="bold")
        console.print_table(table)
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
    """Return the command line, for the labels of results; bytes of it that are not UTF-8 are escaped."""
    return " ".join(["uavmec", *sys.argv[1:]]).encode("utf-8", "backslashreplace").decode()
