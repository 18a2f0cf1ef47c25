"""Parsers of JSON, TOML and CSV with limits on depth, digits and count; an error is one line that names the source."""

import csv
import json
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from io import StringIO
from pathlib import Path
from typing import Any

from uavmec_jax.errors import UserError
from uavmec_jax.files.reading import read_text

MAX_DEPTH = 40
"""Deepest nesting of tables and arrays."""

MAX_DIGITS = 40
"""Longest whole number, in digits: every field that holds one has bounds far below."""

MAX_TOML_CHARACTERS = 2**20
"""Longest TOML: a scenario of the most devices takes a tenth of it."""

MAX_VALUE_CHARACTERS = 100_000
"""Longest value of ``--set``."""

MAX_ROWS = 100_000
MAX_COLUMNS = 1000
MAX_CELL = 10_000
"""Longest cell of a CSV, in characters."""

_TOO_DEEP = f"{{}}: is nested too deep; tables and arrays may be nested {MAX_DEPTH} times"

_SEPARATORS = (",", ";", "\t")

_DEEP_KEY = re.compile(
    r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){%d}""" % MAX_DEPTH  # noqa: UP031 (braces)
)
"""A dotted key that opens more tables than are allowed; the time that tomllib takes for one grows with its square."""


def parse_toml(text: str, source: object, error: type[UserError]) -> dict[str, Any]:
    """Parse the text of a TOML file; ``source`` names it in messages.

    Raises:
        UserError: the text is not TOML or exceeds a limit; of the type ``error``.
    """
    if len(text) > MAX_TOML_CHARACTERS:
        raise error(f"{source}: holds {len(text)} characters; TOML here has at most {MAX_TOML_CHARACTERS}")
    if _DEEP_KEY.search(text):
        raise error(_TOO_DEEP.format(source))
    return _parsed(lambda: tomllib.loads(text), "TOML", source, error)


def parse_json(text: str | bytes, source: object, error: type[UserError]) -> Any:
    """Parse the text of a JSON file; ``source`` names it in messages.

    Raises:
        UserError: the text is not JSON, gives a key twice, holds NaN or infinity, or exceeds a limit; of the type ``error``.
    """
    return _parsed(
        lambda: json.loads(
            text, object_pairs_hook=_distinct, parse_constant=_not_a_number, parse_int=_whole, parse_float=_finite
        ),
        "JSON",
        source,
        error,
    )


def read_json_object(path: Path, error: type[UserError]) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises:
        UserError: the file cannot be read, is not JSON, or holds something else; of the type ``error``.
    """
    content = parse_json(read_text(path, error), path, error)
    if not isinstance(content, dict):
        raise error(f"{path}: holds {_KINDS.get(type(content), 'null')}; it should hold an object, {{...}}")
    return content


_KINDS = {list: "a list", str: "text", bool: "a truth value", int: "a number", float: "a number"}


def parse_value(text: str) -> Any:
    """Parse a value as TOML writes it, such as ``0.5``, ``true``, ``"a"`` or ``[1, 2]``; what is none is a string.

    Raises:
        UserError: the value exceeds a limit.
    """

    def value() -> Any:
        try:
            data = tomllib.loads(f"value = {text}")
        except tomllib.TOMLDecodeError:
            return text.strip()
        return data["value"] if len(data) == 1 else text.strip()

    if len(text) > MAX_VALUE_CHARACTERS:
        raise UserError(f"the value holds {len(text)} characters; give at most {MAX_VALUE_CHARACTERS}")
    if _DEEP_KEY.search(text):
        raise UserError(_TOO_DEEP.format("the value"))
    return _parsed(value, "TOML", "the value", UserError)


def parse_csv(text: str, source: object, error: type[UserError]) -> tuple[list[str], list[dict[str, str]]]:
    """Parse the text of a table whose first line names its columns; the separator is a comma, a semicolon or a tab.

    Returns:
        The names of the columns, and the rows by column, cells that are missing as ``""``. Blank lines are left out.

    Raises:
        UserError: the table has no line, a line has more cells than there are columns, a column is named twice or not at
            all, or a limit is exceeded; of the type ``error``, with the number of the line.
    """
    lines = _lines(text, source, error)
    number, header = next(lines, (1, []))
    columns = [name.strip() for name in header]
    if not any(columns):
        raise error(f"{source}: is empty; its first line should name its columns")
    while not columns[-1]:  # a separator at the end of the line
        columns.pop()
    if len(columns) > MAX_COLUMNS:
        raise error(f"{source}: line {number} names {len(columns)} columns; give at most {MAX_COLUMNS}")
    for place, name in enumerate(columns, 1):
        if not name:
            raise error(f"{source}: line {number}: column {place} has no name")
        if columns.index(name) != place - 1:
            raise error(f"{source}: line {number}: column {name!r} is named twice")
    rows: list[dict[str, str]] = []
    for number, cells in lines:
        if any(cell.strip() for cell in cells[len(columns) :]):
            raise error(f"{source}: line {number} has {len(cells)} cells; there are {len(columns)} columns")
        if len(rows) == MAX_ROWS:
            raise error(f"{source}: has more than {MAX_ROWS} rows; give fewer")
        padded = [cell.strip() for cell in cells] + [""] * len(columns)
        rows.append(dict(zip(columns, padded, strict=False)))
    return columns, rows


def _lines(text: str, source: object, error: type[UserError]) -> Iterator[tuple[int, list[str]]]:
    """Yield the cells of each line that is not blank, and its number."""
    first = next((line for line in text.splitlines() if line.strip()), "")
    separator = max(_SEPARATORS, key=first.count)
    reader = csv.reader(StringIO(text, newline=""), delimiter=separator, skipinitialspace=True, strict=True)
    try:
        for cells in reader:
            if (longest := max(map(len, cells), default=0)) > MAX_CELL:
                raise error(
                    f"{source}: line {reader.line_num} has a cell of {longest:,} characters; give at most {MAX_CELL:,}"
                )
            if any(cell.strip() for cell in cells):
                yield reader.line_num, cells
    except csv.Error as problem:
        if "field limit" in str(problem):
            raise error(f"{source}: line {reader.line_num} has a longer cell than {MAX_CELL:,} characters") from None
        raise error(f"{source}: line {reader.line_num} is not CSV: {problem}") from None


def _parsed(parse: Callable[[], Any], form: str, source: object, error: type[UserError]) -> Any:
    """Return what a parser returns, and turn what it raises into one line."""
    try:
        data = parse()
        deep = _depth_exceeds(data, MAX_DEPTH)
    except RecursionError:
        data, deep = None, True
    except ValueError as problem:  # TOMLDecodeError and JSONDecodeError among them
        raise error(f"{source}: not {form}: {_in_words(problem)}") from None
    if deep:
        raise error(_TOO_DEEP.format(source))
    _check_whole_numbers(data, source, error)
    return data


def _in_words(problem: ValueError) -> str:
    """Return what was wrong, also where it was Python's own limit on digits."""
    too_long = "integer string conversion" in str(problem)
    return f"a whole number has more than {MAX_DIGITS} digits" if too_long else str(problem)


def _levels(data: Any) -> Iterator[list[Any]]:
    """Yield the values of each level of tables and arrays, from the outermost level inwards."""
    level = [data]
    while level:
        yield level
        containers = (value for value in level if isinstance(value, dict | list))
        level = [part for value in containers for part in (value.values() if isinstance(value, dict) else value)]


def _depth_exceeds(data: Any, limit: int) -> bool:
    """Return whether tables and arrays are nested more than ``limit`` times."""
    deepest = (level for depth, level in enumerate(_levels(data)) if depth >= limit)
    return any(isinstance(value, dict | list) for level in deepest for value in level)


def _check_whole_numbers(data: Any, source: object, error: type[UserError]) -> None:
    """Check that no whole number is too long to be shown."""
    limit = 10**MAX_DIGITS
    for level in _levels(data):
        if any(isinstance(value, int) and abs(value) >= limit for value in level):
            raise error(f"{source}: holds a whole number of more than {MAX_DIGITS} digits")


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; of a key that is given twice, JSON's readers keep one without a word."""
    table = dict(pairs)
    if len(table) < len(pairs):
        key, _ = Counter(key for key, _ in pairs).most_common(1)[0]
        raise ValueError(f"{key!r} is given twice")
    return table


def _whole(digits: str) -> int:
    if len(digits) > MAX_DIGITS + 1:  # and a sign
        raise ValueError(f"a whole number has more than {MAX_DIGITS} digits")
    return int(digits)


def _finite(text: str) -> float:
    value = float(text)
    if value in (float("inf"), float("-inf")):
        raise ValueError(f"{text[:40]} is too large for a number")
    return value


def _not_a_number(name: str) -> Any:
    raise ValueError(f"it holds {name}, which is not a number of JSON")
