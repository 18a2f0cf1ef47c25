"""Running the experiment scripts of the clone."""

import subprocess
import sys
from pathlib import Path

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def run(script, *arguments):
    """Run a script, and return its output."""
    command = [sys.executable, EXPERIMENTS / script, *map(str, arguments)]
    process = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert process.returncode == 0, process.stderr
    return process.stdout
