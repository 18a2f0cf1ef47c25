"""What the lines of advice to a fleet say."""

import pytest

from uavmec_jax.planning.advice import RETURN_SLOTS, UavAdvice
from uavmec_jax.reporting.fleet_advice import _return


@pytest.mark.parametrize(
    ("advice", "action", "words"),
    [
        (UavAdvice((), 0), "visit", f"; no return to a depot within {RETURN_SLOTS} slots in most futures"),
        (UavAdvice((), 0), "grounded", ""),
        (UavAdvice((), 0, 1.0, 600.0), "stay", "; it returns to a depot in 10 min (1 slot)"),
        (UavAdvice((), 0, 0.0, 0.0), "visit", ""),
    ],
)
def test_when_a_uav_returns(advice, action, words):
    assert _return(advice, action) == words
