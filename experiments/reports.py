"""Reports of experiments."""

import json
from pathlib import Path
from typing import Any

from uavmec_jax.files.writing import write_text


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write a report as JSON; its folder is made if it does not exist."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(report, indent=1) + "\n")
