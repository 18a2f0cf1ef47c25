"""Tables that fit a terminal: names wrap first, then headings, then columns go below; no number is ever cut."""

from dataclasses import replace

from rich.console import Console, RenderableType
from rich.measure import Measurement
from rich.table import Column, Table

_BORDER = 3
"""Width of a column's border and padding."""

_NAME = 12
"""Width to which names may be folded, in letters."""


def fitted(table: Table, console: Console) -> list[Table]:
    """Return a table as it is if the console is wide enough, else one or more tables that fit and hold all of it.

    What stands on the left of its column is a name, which wraps; what stands on the right is a number, which does not, but
    its heading does. If there are too many columns, the first one is repeated before those that go below.
    """
    room = console.width - 1
    if sum(_widest(console, column) + _BORDER for column in table.columns) <= room:
        return [table]
    columns = [_narrow(console, column) for column in table.columns]
    least = [_least(console, column) + _BORDER for column in columns]
    parts, used = [[0]], least[0]
    for index in range(1, len(columns)):
        if used + least[index] > room and len(parts[-1]) > 1:
            parts.append([0])
            used = least[0]
        parts[-1].append(index)
        used += least[index]
    return [_part(table, columns, part) for part in parts]


def _is_name(column: Column) -> bool:
    return column.justify != "right"


def _measured(console: Console, *contents: RenderableType) -> list[Measurement]:
    """Measure contents as if there were room for them."""
    return [Measurement.get(console, console.options.update_width(10_000), content) for content in contents]


def _widest(console: Console, column: Column) -> int:
    return max(measured.maximum for measured in _measured(console, column.header, *column.cells))


def _least(console: Console, column: Column) -> int:
    """Return the least width of a column: of a number's, that of its cells and of the longest word of its heading."""
    words = max((len(word) for word in str(column.header).split()), default=0)
    measured = _measured(console, *column.cells)
    if _is_name(column):
        return max([words, *(min(cell.minimum, _NAME) for cell in measured)])
    return max([words, *(cell.maximum for cell in measured)])


def _narrow(console: Console, column: Column) -> Column:
    """Return a column with a heading that has a word in each line, if it is wider than what is below."""
    if _is_name(column):
        return replace(column, no_wrap=False, overflow="fold")
    cells = max((cell.maximum for cell in _measured(console, *column.cells)), default=0)
    heading = str(column.header)
    wide = max((len(line) for line in heading.splitlines()), default=0) > cells
    return replace(column, header="\n".join(heading.split()) if wide else column.header, no_wrap=True)


def _part(table: Table, columns: list[Column], part: list[int]) -> Table:
    """Return a table of some of the columns."""
    shown = Table(show_lines=table.show_lines)
    shown.columns = [replace(columns[index], _index=place) for place, index in enumerate(part)]
    shown.rows = table.rows
    return shown
