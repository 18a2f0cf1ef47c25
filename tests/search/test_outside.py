"""Search spaces from outside: whatever they hold, they are refused in one line."""

import pytest

from tests.scenarios.test_outside import DEEP
from uavmec_jax.errors import StudyError
from uavmec_jax.search.space import load_space, shipped_spaces

NAME = next(iter(shipped_spaces()))

CHANGES = {
    "unhashable choices": ({"space": {"guide": {"choices": [[1], {}]}}}, "space.guide has [1]"),
    "lists of lists": ({"space": {"hidden": {"choices": [[[1]], [{}]]}}}, "space.hidden has [[1]]"),
    "a list as a space": ({"space": [1]}, "space is [1]"),
    "a number as a range": ({"space": {"gamma": 3}}, "space.gamma"),
    "39 digits": ({"trials": 10**39}, "trials is 1000"),
    "a huge range": ({"space": {"gamma": {"low": -1e300, "high": 1e300}}}, "space.gamma"),
    "no study": ({"study": "a\0b"}, "neither a study file"),
    "a name for a terminal": ({"name": "\x1b[2J"}, "name is '\\x1b[2J'"),
}


@pytest.mark.parametrize(("changes", "message"), CHANGES.values(), ids=CHANGES)
def test_a_space_that_cannot_be_is_refused_in_one_line(changes, message):
    with pytest.raises(StudyError) as error:
        load_space(NAME, changes)
    assert message in str(error.value)
    assert str(error.value).isprintable()
    assert len(str(error.value)) <= 400


@pytest.mark.parametrize("text", [f"trials = {'9' * 5000}\n", f"space = {DEEP}\n", f"{'a.' * 20_000}a = 1\n"])
def test_a_file_that_a_parser_chokes_on_is_refused(tmp_path, text):
    path = tmp_path / "space.toml"
    path.write_text(text)
    with pytest.raises(StudyError) as error:
        load_space(str(path))
    assert str(error.value).startswith(f"{path}: ")
    assert len(str(error.value)) <= 400


@pytest.mark.parametrize("path", ["a\0b.toml", "a" * 5000, "", "/dev/zero"])
def test_what_is_the_path_of_no_file_is_refused_at_once(path):
    with pytest.raises(StudyError, match="neither a file of a search space nor a shipped one"):
        load_space(path)
