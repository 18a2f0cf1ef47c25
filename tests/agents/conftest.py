"""Fixtures of the agents' tests."""

import jax
import pytest


@pytest.fixture(params=[False, True], ids=["eager", "jit"])
def jit(request):
    """``jax.jit``, or nothing: the numbers must be the same either way."""
    return jax.jit if request.param else lambda function: function
