"""Make the modules beside the scripts importable, as they are when Python runs a script."""

import sys

from tests.experiments.scripts import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS))
