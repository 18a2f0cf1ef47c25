"""Tables in narrow terminals: nothing is cut and nothing is lost."""

import io
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.table import Table

from uavmec_jax.cli.console import PlainConsole

NAMES = st.text("abcdefgh -", min_size=1, max_size=40)
NUMBERS = st.floats(-1e6, 1e6).map(lambda number: f"{number:.1f} ±{abs(number) / 10:.1f}")


def printed(table, width):
    """What a console of some width prints of a table."""
    console = PlainConsole(width=width, file=io.StringIO())
    console.print_table(table)
    return console.file.getvalue()


def make(rows, columns):
    table = Table()
    table.add_column("device")
    for number in range(columns):
        table.add_column(f"share of slot {number}", justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


@settings(max_examples=100, deadline=None)
@given(st.data(), st.integers(1, 12), st.integers(1, 4), st.integers(30, 100))
def test_no_number_is_cut_and_no_column_is_lost(data, columns, rows, width):
    drawn = [(data.draw(NAMES), *(data.draw(NUMBERS) for _ in range(columns))) for _ in range(rows)]
    text = printed(make(drawn, columns), width)
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= width
    lines = [[cell.strip() for cell in re.split("[│┃]", line)] for line in text.splitlines()]
    cells = [cell for line in lines for cell in line]
    names = "".join(
        "".join(line[1].split()) for line in lines if len(line) > 1
    )  # those that wrap go on in the next line
    for name, *numbers in drawn:
        for number in numbers:
            assert number in cells
        assert "".join(name.split()) in names
    assert str(columns - 1) in cells or any(cell.endswith(f" {columns - 1}") for cell in cells)


def test_a_table_with_room_is_left_alone():
    table = make([("tower", "1.0 ±0.1")], 1)
    text = printed(table, 80)
    assert "share of slot 0" in text
    assert len(text.splitlines()) == 5


@pytest.mark.parametrize(("width", "tables"), [(90, 1), (60, 2), (40, 2), (28, 4)])
def test_columns_go_below_with_the_first_one_repeated(width, tables):
    text = printed(make([("the tower at the end of the road", *["100.0 ±10.0"] * 4)], 4), width)
    assert text.count("device") == tables
    assert text.count("100.0 ±10.0") == 4
