"""Every script can be imported: names that it takes from the package are there. Most are run by pytest -m full alone."""

import importlib

import pytest

from tests.experiments.scripts import EXPERIMENTS

OF_OTHER_GROUPS = (
    *("gymnax_client", "parity_purejaxql", "parity_sb3", "parity_training_sb3", "sb3_quality", "train_with_rejax"),
    "vec_env_speed",
)
"""Scripts for packages outside the test run."""


@pytest.mark.parametrize("script", sorted({file.stem for file in EXPERIMENTS.glob("*.py")} - set(OF_OTHER_GROUPS)))
def test_a_script_can_be_imported(script):
    assert importlib.import_module(script).__doc__
