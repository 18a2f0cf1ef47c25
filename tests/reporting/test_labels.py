"""How times are written."""

import pytest

from uavmec_jax.reporting.labels import duration, hours


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(30, "0.5 min"), (3000, "50 min"), (5400, "1.5 h"), (45_000, "12.5 h"), (38_160, "10.6 h"), (360_000, "100 h")],
)
def test_duration(seconds, words):
    assert duration(seconds) == words


def test_hours():
    assert [hours(seconds) for seconds in (0, 29, 18_420, 360_000)] == ["0:00", "0:00", "5:07", "100:00"]
