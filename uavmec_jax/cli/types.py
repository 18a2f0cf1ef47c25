"""Types of arguments and options. What is outside their bounds is refused in one line, before anything heavy is imported."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from uavmec_jax.cli.common import InputError, is_utf8

_MAX_PATH_BYTES, _MAX_NAME_BYTES = 4095, 255
"""What file systems take: bytes of a path, and of each name in it."""

MAX_SECONDS = 31_536_000.0
"""Longest time that an option takes: a year."""


_Number = TypeVar("_Number", int, float)


def name_of(param: click.Parameter | None) -> str:
    """Return how messages name an option or an argument."""
    if param is None:
        return "the value"
    return max(param.opts, key=len) if isinstance(param, click.Option) else (param.name or "the argument").upper()


def check_location(location: object, param: click.Parameter | None) -> None:
    """Refuse what cannot be the path of a file, or written into results: an empty text, a NUL character, bytes that are not
    UTF-8, what is longer than file systems take.

    Raises:
        InputError: one line that names the option.
    """
    from uavmec_jax.files.locations import is_url

    text = os.fspath(location) if isinstance(location, os.PathLike) else str(location)
    if not text:
        raise InputError(f"{name_of(param)} is empty; give a path or a name")
    if "\0" in text:
        raise InputError(f"{name_of(param)} is {text!r}; it contains a NUL character, which no path can contain")
    if not is_utf8(text):
        raise InputError(
            f"{name_of(param)} is {text!r}; it holds bytes that are not UTF-8; give a file with another name"
        )
    names = text.encode().split(b"/")
    longest = 0 if is_url(text) else max(map(len, names))
    if sum(map(len, names)) + len(names) - 1 > _MAX_PATH_BYTES or longest > _MAX_NAME_BYTES:
        raise InputError(
            f"{name_of(param)} is {text!r}; it has {len(text.encode()):,} bytes; a path has at most {_MAX_PATH_BYTES:,}, "
            f"and each name in it at most {_MAX_NAME_BYTES}"
        )


class LocalPath(click.Path):
    """A path of this machine."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path, and refuse what cannot be one, and a URL, of which a path would be made."""
        from uavmec_jax.files.locations import is_url

        check_location(value, param)
        if is_url(value):
            raise InputError(f"{value}: is in an object store, where only runs can be; give a path of this machine")
        return super().convert(value, param, ctx)


class Location(click.ParamType):
    """A path of this machine, or a URL of an object store."""

    name = "path"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path, and refuse what cannot be one."""
        from uavmec_jax.files.locations import to_path

        check_location(value, param)
        return to_path(value)


class FolderOfRun(Location):
    """A folder on this machine, or the URL of one in an object store."""

    name = "folder"


class NameOrPath(click.ParamType):
    """The name of something that ships with the package, or the path or URL of a file; the text as it was given."""

    name = "text"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the text, and refuse what can be neither."""
        check_location(value, param)
        return str(value)


def _within(
    bounds: Any, parse: Callable[[Any], _Number], value: Any, param: click.Parameter | None, right: str
) -> _Number:
    """Return a value as a number between two bounds, neither of which NaN is.

    Raises:
        InputError: it is no number or out of bounds; the line says what would be ``right``.
    """
    try:
        number = parse(value)
    except ValueError:
        raise InputError(f"{name_of(param)} is {value!r}; give {right}") from None
    if not bounds.min <= number <= bounds.max:
        raise InputError(f"{name_of(param)} is {value}; give {right}")
    return number


class WholeNumber(click.IntRange):
    """A whole number between two bounds."""

    def __init__(self, least: int, most: int) -> None:
        super().__init__(least, most)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the number, and refuse what is none or out of bounds."""
        return _within(self, int, value, param, f"a whole number from {self.min} to {self.max}")


class FiniteRange(click.FloatRange):
    """A number between two bounds, which leave out NaN and infinity."""

    def __init__(self, least: float, most: float) -> None:
        super().__init__(least, most)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number, and refuse what is none or out of bounds."""
        return _within(self, float, value, param, f"a number from {self.min:g} to {self.max:,.10g}")


def given(*names: str) -> list[str]:
    """Return those of a command's options that are on its command line, as they are written there.

    Args:
        names: names of the command's parameters.
    """
    context = click.get_current_context()
    on_command_line = click.core.ParameterSource.COMMANDLINE
    options = {param.name: name_of(param) for param in context.command.params}
    return [options[name] for name in names if context.get_parameter_source(name) is on_command_line]


def refuse_given(why: str, *names: str) -> None:
    """Refuse options that would be ignored.

    Args:
        why: what the message says about the first of them, e.g. ``is only for --simulate``.
        names: names of the command's parameters.

    Raises:
        InputError: one of them is on the command line; one line that names it.
    """
    if options := given(*names):
        raise InputError(f"{options[0]} {why}; leave it out")
