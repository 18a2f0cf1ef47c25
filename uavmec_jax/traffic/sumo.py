"""Where SUMO is; it is an extra of the package, and nothing but `uavmec traffic build` needs it."""

import importlib
import os
from pathlib import Path
from typing import Any

from uavmec_jax.errors import TrafficError


def _package(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise TrafficError(
            f"SUMO is not installed ({error}); install it: pip install 'uavmec-jax[traffic]', or uv sync --extra traffic"
        ) from None


def home() -> Path:
    """The folder of SUMO's programs and data.

    Raises:
        TrafficError: SUMO is not installed.
    """
    return Path(_package("sumo").SUMO_HOME)


def version() -> str:
    """SUMO's version, e.g. ``1.28.0``.

    Raises:
        TrafficError: SUMO is not installed.
    """
    return str(_package("libsumo").getVersion()[1]).removeprefix("SUMO ")


def environment() -> dict[str, str]:
    """What SUMO's programs look for in the environment."""
    return {"SUMO_HOME": str(home())}


def program(name: str) -> Path:
    """The path of one of SUMO's programs.

    Raises:
        TrafficError: SUMO is not installed, or has no such program.
    """
    path = home() / "bin" / (f"{name}.exe" if os.name == "nt" else name)
    if not path.is_file():
        raise TrafficError(f"SUMO has no {name} in {path.parent}; install it again")
    return path


def read_network(path: Path) -> Any:
    """A checked network file as sumolib's ``Net``, without internal edges.

    Raises:
        TrafficError: SUMO is not installed, or the network does not make sense.
    """
    try:
        return _package("sumolib.net").readNet(str(path), withInternal=False)
    except TrafficError:
        raise
    except Exception as error:  # sumolib trusts its input and raises whatever it stumbles over
        raise TrafficError(f"{path.name}: is not a network that SUMO can read: {error!r}") from None
