"""Sites: where the devices of a place stand, listed in its file or in a file of their own."""

from pathlib import Path
from typing import Annotated, Any

import pydantic
from pydantic import Field

from uavmec_jax.env.checks import MAX_LENGTH_M
from uavmec_jax.env.params import MAX_DEVICES
from uavmec_jax.errors import TrafficError
from uavmec_jax.files.parsing import parse_toml
from uavmec_jax.files.reading import read_text
from uavmec_jax.files.validation import PrintableName, PrintableText, StrictModel, from_array, validated

_Metres = Annotated[float, Field(ge=-MAX_LENGTH_M, le=MAX_LENGTH_M)]


class Site(StrictModel):
    """A device of the file: at a junction, or at a point of the network in metres."""

    name: PrintableName
    junction: PrintableText | None = None
    x_m: _Metres | None = None
    y_m: _Metres | None = None


_POSITIONS = ((True, False, False), (False, True, True))
"""Which of junction, x_m and y_m are missing where the position is clear."""

Sites = Annotated[tuple[Site, ...], from_array]


class SiteFile(StrictModel):
    """A file of devices alone."""

    device: Sites = ()

    @pydantic.model_validator(mode="before")
    @classmethod
    def _check_data(cls, data: Any) -> Any:
        return refuse_degrees(data)

    @pydantic.model_validator(mode="after")
    def _check(self) -> "SiteFile":
        if not self.device:
            raise ValueError("holds no [[device]] tables")
        check_sites(self.device)
        return self


def load_sites(path: Path) -> list[dict[str, Any]]:
    """Load a file of devices, as the tables ``device`` of a place.

    Raises:
        TrafficError: the file cannot be read, is not TOML, or holds an invalid or unknown value; one line.
    """
    data = parse_toml(read_text(path, TrafficError), path, TrafficError)
    validated(SiteFile, data, path, TrafficError)
    tables: list[dict[str, Any]] = data["device"]
    return tables


def check_sites(sites: tuple[Site, ...]) -> None:
    """Check that sites are as many as a scenario has devices, have one position each, and names that differ.

    Raises:
        ValueError: they are not.
    """
    if not 2 <= len(sites) <= MAX_DEVICES:
        raise ValueError(f"holds {len(sites)} [[device]] tables; give 2 to {MAX_DEVICES}, or none")
    number_of: dict[str, int] = {}
    for number, site in enumerate(sites, 1):
        if (site.junction is None, site.x_m is None, site.y_m is None) not in _POSITIONS:
            raise ValueError(f"{site_label(number, site.name)}: place is unclear; give junction, or x_m and y_m")
        if site.name in number_of:
            raise ValueError(
                f"devices {number_of[site.name]} and {number} are both named {site.name!r}; names must differ"
            )
        number_of[site.name] = number


def refuse_degrees(data: Any) -> Any:
    """Refuse devices in degrees, which are right in scenario files; other data are returned as they are.

    Raises:
        ValueError: a device has a longitude or a latitude.
    """
    tables = data.get("device") if isinstance(data, dict) else None
    for number, table in enumerate(tables if isinstance(tables, list | tuple) else (), 1):
        if isinstance(table, dict) and (given := [name for name in ("lon", "lat") if name in table]):
            label = site_label(number, table.get("name", "no name"))
            raise ValueError(
                f"{label}: gives {' and '.join(given)}; degrees are not read here, "
                f"give x_m and y_m in the metres of the network, or junction (known: {', '.join(Site.model_fields)})"
            )
    return data


def site_label(number: int, name: object) -> str:
    """Return how messages name a device, e.g. ``device 2 (quay)``."""
    return f"device {number} ({name})"
