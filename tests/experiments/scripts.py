"""Run an experiment script of the clone, small."""

import os
import subprocess
import sys
from pathlib import Path

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


QUICKLY_COMPILED = {"XLA_FLAGS": "--xla_backend_optimization_level=1"}
"""What runs for a moment is compiled for longer: here the machine code is left as it comes."""


def run(script, *arguments):
    command = [sys.executable, EXPERIMENTS / script, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, env=os.environ | QUICKLY_COMPILED)
    assert done.returncode == 0, done.stderr
    return done.stdout
