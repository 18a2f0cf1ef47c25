"""Messages: one printable line, whatever was given."""

import pickle

import pytest

from uavmec_jax.errors import MAX_MESSAGE, ArgumentError, StudyError, UserError, one_line


def test_a_long_message_keeps_its_ends():
    message = one_line(f"file.toml: name is {'x' * 10**6!r}; give at most 80 characters")
    assert len(message) == MAX_MESSAGE
    assert message.startswith("file.toml: name is 'xxx")
    assert message.endswith("xxx'; give at most 80 characters")


@pytest.mark.parametrize("text", ["a\nb", "a\r\n\tb", " a  b "])
def test_a_message_is_one_line(text):
    assert one_line(text) == "a b"


def test_what_a_terminal_would_obey_is_escaped():
    assert (
        one_line("red \x1b[31m, back \x08, half \ud800, name Łódź")
        == r"red \x1b[31m, back \x08, half \ud800, name Łódź"
    )


def test_escapes_count():
    assert len(one_line("\x1b" * MAX_MESSAGE)) == MAX_MESSAGE


def test_every_error_is_one_line_and_can_be_pickled():
    error = pickle.loads(pickle.dumps(StudyError("a\nb" + "c" * 1000)))
    assert type(error) is StudyError
    assert len(str(error)) == MAX_MESSAGE
    assert issubclass(ArgumentError, UserError)
    assert issubclass(UserError, ValueError)
