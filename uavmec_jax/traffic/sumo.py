"""Locate and load SUMO, an optional extra of the package that only `uavmec traffic build` needs."""

import importlib
import os
from pathlib import Path
from typing import Any

from uavmec_jax.errors import TrafficError


def _import_module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise TrafficError(
            f"SUMO is not installed ({error}); install it: pip install 'uavmec-jax[traffic]', or uv sync --extra traffic"
        ) from None


def home() -> Path:
    """Return the folder of SUMO's programs and data.

    Raises:
        TrafficError: SUMO is not installed.
    """
    return Path(_import_module("sumo").SUMO_HOME)


def version() -> str:
    """Return SUMO's version, e.g. ``1.28.0``.

    Raises:
        TrafficError: SUMO is not installed.
    """
    return str(_import_module("libsumo").getVersion()[1]).removeprefix("SUMO ")


def environment() -> dict[str, str]:
    """Return the environment variables that SUMO's programs need."""
    return {"SUMO_HOME": str(home())}


def program(name: str) -> Path:
    """Return the path of one of SUMO's programs.

    Raises:
        TrafficError: SUMO is not installed, or has no such program.
    """
    path = home() / "bin" / (f"{name}.exe" if os.name == "nt" else name)
    if not path.is_file():
        raise TrafficError(f"SUMO has no {name} in {path.parent}; install it again")
    return path


def read_network(path: Path) -> Any:
    """Read a checked network file into sumolib's ``Net``, without internal edges.

    Raises:
        TrafficError: SUMO is not installed, or cannot read the network; the line is without the name of the file.
    """
    try:
        return _import_module("sumolib.net").readNet(str(path), withInternal=False)
    except TrafficError:
        raise
    except Exception as error:  # sumolib trusts its input; bad input raises exceptions of all kinds
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error) or type(error).__name__
        raise TrafficError(f"is not a network that SUMO can read: {reason}") from None
