"""Parsers: what is valid is read, and whatever else is given ends in one line, soon."""

import time

import pytest

from uavmec_jax.errors import StudyError, UserError
from uavmec_jax.files.parsing import MAX_DEPTH, parse_csv, parse_json, parse_toml, parse_value, read_json_object


@pytest.fixture(autouse=True)
def soon():
    """No input takes long, on a busy machine either."""
    start = time.monotonic()
    yield
    assert time.monotonic() - start < 10


def nested(depth):
    return "[" * depth + "]" * depth


def test_what_is_nested_within_the_limit_is_read():
    assert parse_json(nested(MAX_DEPTH), "x", StudyError)
    assert parse_toml(f"a = {nested(MAX_DEPTH - 1)}", "x", StudyError)


@pytest.mark.parametrize("depth", [MAX_DEPTH + 1, 20_000, 200_000])
def test_what_is_nested_too_deep_is_refused(depth):
    for parse, text in ((parse_json, nested(depth)), (parse_toml, f"a = {nested(depth)}")):
        with pytest.raises(StudyError, match=r"^x: is nested too deep; tables and arrays may be nested 40 times$"):
            parse(text, "x", StudyError)


@pytest.mark.parametrize(
    "text", [".".join("a" * 50_000) + " = 1", "[" + ".".join("a" * 50_000) + "]", ' . '.join(['"a"'] * 99) + " = 1"],
    ids=["key", "header", "quoted"],
)  # fmt: skip
def test_a_dotted_key_that_nests_too_deep_is_refused(text):
    with pytest.raises(StudyError, match=r"^x: is nested too deep"):
        parse_toml(text, "x", StudyError)


def test_inline_tables_that_nest_too_deep_are_refused():
    with pytest.raises(StudyError, match=r"^x: is nested too deep"):
        parse_toml("a = " + "{a = " * 100 + "1" + "}" * 100, "x", StudyError)


def test_200_000_open_brackets_are_refused():
    for parse in (parse_json, parse_toml):
        with pytest.raises(StudyError, match=r"^x: "):
            parse("[" * 200_000, "x", StudyError)


@pytest.mark.parametrize("digits", [41, 5_000, 100_000])
def test_a_whole_number_of_many_digits_is_refused(digits):
    number = "9" * digits
    for parse, text in ((parse_json, number), (parse_json, f"[-{number}]"), (parse_toml, f"a = {number}")):
        with pytest.raises(StudyError, match=r"^x: .*a whole number .*more than 40 digits$"):
            parse(text, "x", StudyError)


def test_a_key_that_is_given_twice_is_refused():
    with pytest.raises(StudyError, match=r"^x: not JSON: 'a' is given twice$"):
        parse_json('{"b": {"a": 1, "a": 2}}', "x", StudyError)
    with pytest.raises(StudyError, match=r"^x: not TOML: "):
        parse_toml("a = 1\na = 2", "x", StudyError)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_json_holds_finite_numbers(number):
    with pytest.raises(StudyError, match=r"^x: not JSON: "):
        parse_json(f'{{"a": {number}}}', "x", StudyError)


def test_a_toml_of_megabytes_is_refused():
    with pytest.raises(StudyError, match=r"^x: holds 2000000 characters; TOML here has at most 1048576$"):
        parse_toml("#" * 2_000_000, "x", StudyError)


@pytest.mark.parametrize(("text", "kind"), [("[1]", "a list"), ("3", "a number"), ("null", "null"), ('"a"', "text")])
def test_json_that_is_no_object_is_refused(tmp_path, text, kind):
    path = tmp_path / "x.json"
    path.write_text(text)
    with pytest.raises(StudyError, match=rf"x\.json: holds {kind}; it should hold an object"):
        read_json_object(path, StudyError)


def test_a_value_is_one_value_or_text():
    assert parse_value("[1, 2]") == [1, 2]
    for text in ("1\nother = 2", "", "1 2", "dqn"):
        assert parse_value(text) == text
    for text in (nested(20_000), "9" * 5000, ".".join("a" * 50_000), "x" * 200_000, "[" + "1," * 60_000 + "]"):
        with pytest.raises(UserError, match=r"^the value"):
            parse_value(text)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_the_separator_of_a_table_is_found(separator):
    text = separator.join(("name", "x_m", "y_m")) + "\n" + separator.join(('"a, b; c\t"', "1", "")) + "\n\n"
    assert parse_csv(text, "x", StudyError) == (["name", "x_m", "y_m"], [{"name": "a, b; c", "x_m": "1", "y_m": ""}])


def test_cells_that_are_missing_or_empty_at_the_end_of_a_line():
    columns, rows = parse_csv("a,b,\n1\n2,3,,\n", "x", StudyError)
    assert columns == ["a", "b"]
    assert rows == [{"a": "1", "b": ""}, {"a": "2", "b": "3"}]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty; its first line should name its columns"),
        ("\n,,\n", "is empty; its first line should name its columns"),
        ("a,,b\n", "line 1: column 2 has no name"),
        ("a,b,a\n", "line 1: column 'a' is named twice"),
        ("a,b\n1,2\n1,2,3\n", "line 3 has 3 cells; there are 2 columns"),
        ("a\n" + "x" * 20_000, "line 2 has a cell of 20,000 characters; give at most 10,000"),
        ("a\n" + "x" * 200_000, "line 2 has a longer cell than 10,000 characters"),
        ('a\n"' + "x" * 200_000, "line 2 has a longer cell than 10,000 characters"),
        ('a\n"b', "line 2 is not CSV: unexpected end of data"),
        (",".join(f"c{k}" for k in range(2000)), "line 1 names 2000 columns; give at most 1000"),
        ("a\n" + "1\n" * 100_001, "has more than 100000 rows; give fewer"),
    ],
    ids=[
        "empty",
        "blank",
        "no name",
        "twice",
        "too many",
        "long",
        "longer",
        "unclosed and long",
        "unclosed",
        "wide",
        "tall",
    ],
)
def test_a_table_that_is_not_one_is_refused(text, message):
    with pytest.raises(StudyError, match=f"^x: {message}"):
        parse_csv(text, "x", StudyError)
