"""Study files from outside: whatever they hold, they are refused in one line."""

import pytest

from tests.scenarios.test_outside import DEEP
from uavmec_jax.errors import StudyError
from uavmec_jax.studies.study import load_study, parse_study

AXES = "[axes]\npowered = [8]\nconnected = [8]\nseeds = 1\n"

TEXTS = {
    "5,000 digits": (f"steps = {'9' * 5000}\n{AXES}", "a whole number has more than 40 digits"),
    "steps beyond int32": (
        f"steps = 3000000000\n{AXES}",
        "steps is 3000000000; it should be less than or equal to 2000000000",
    ),
    "20,000 brackets": (f"{AXES}gamma = {DEEP}\n", "is nested too deep"),
    "key of 20,000 parts": (f"{AXES}{'a.' * 20_000}a = 1\n", "is nested too deep"),
    "NUL": (
        f'place = "a\\u0000b"\n{AXES}',
        "place is 'a\\x00b'; it should be one line of characters that can be printed",
    ),
    "a depot nowhere": (
        f"{AXES}[[depot]]\nx_m = 1e300\ny_m = 1.0\n",
        "depot 1 (no name): x_m is 1e+300; it should be less",
    ),
    "tiny": (
        f"{AXES}[dqn]\nlearning_rate = 1e-320\n",
        "dqn.learning_rate is 1e-320; it should be 0, or at least 1e-12",
    ),
    "a network of 100,000 layers": (f"{AXES}[dqn]\nhidden = [{'4, ' * 100_000}]\n", "dqn.hidden is (4, 4"),
}


@pytest.mark.parametrize(("text", "message"), TEXTS.values(), ids=TEXTS)
def test_a_study_that_cannot_be_is_refused_in_one_line(text, message):
    with pytest.raises(StudyError) as error:
        parse_study(text, "bad.toml")
    assert message in str(error.value)
    assert str(error.value).startswith("bad.toml: ")
    assert len(str(error.value)) <= 400


UNHASHABLE = ([[1]], [{}], [{"a": [1]}], [[[1, 2], [3]]], [[]], [None])
AXIS_NAMES = (
    *("powered", "connected", "cells", "seeds", "algorithm", "reward", "guard", "place", "traffic_bonus", "uavs"),
    *("depots", "gamma", "normalize_advantage", "data_age_limit_slots", "uav_speed_m_s"),
)


@pytest.mark.parametrize("values", UNHASHABLE, ids=str)
@pytest.mark.parametrize("axis", AXIS_NAMES)
def test_a_list_or_table_as_a_value_of_an_axis_is_refused(axis, values):
    others = {} if axis == "cells" else {"axes.powered": [8], "axes.connected": [8]}
    with pytest.raises(StudyError) as error:
        load_study("table5", others | {f"axes.{axis}": values})
    assert len(str(error.value)) <= 400


@pytest.mark.parametrize("path", ["a\0b.toml", "a" * 5000, f"{'a/' * 3000}b.toml", "", "/dev/zero", "/dev/stdin"])
def test_what_is_the_path_of_no_file_is_refused_at_once(path):
    with pytest.raises(StudyError) as error:
        load_study(path)
    assert len(str(error.value)) <= 400
