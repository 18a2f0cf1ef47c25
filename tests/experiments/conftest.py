"""The helpers beside the scripts are importable, as they are for a script that Python runs."""

import sys

from tests.experiments.scripts import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS))
