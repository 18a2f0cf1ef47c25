"""Fixtures of the tests of the environment."""

import jax
import pytest


@pytest.fixture(params=["jit", "no-jit"])
def with_and_without_jit(request):
    """Run a test twice: with ``jax.jit`` as the code says, and with all functions evaluated operation by operation."""
    with jax.disable_jit(request.param == "no-jit"):
        yield
