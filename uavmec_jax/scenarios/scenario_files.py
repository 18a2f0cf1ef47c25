"""Read and write scenario files: named scenarios in TOML or CSV."""

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from uavmec_jax.env.scenario_checks import check_scenario
from uavmec_jax.env.state_checks import check_state
from uavmec_jax.errors import ScenarioError
from uavmec_jax.files.parsing import parse_csv, parse_toml
from uavmec_jax.files.reading import read_text
from uavmec_jax.files.validation import suggest
from uavmec_jax.scenarios.named_scenario import NamedScenario, make_named_scenario
from uavmec_jax.scenarios.region import wrap_longitudes
from uavmec_jax.scenarios.schema import Device, ScenarioFile

_NEEDED = ("name", "capacity_j")
_POSITIONS = (("x_m", "y_m"), ("lon", "lat"))
"""Columns that a table of devices has to have."""

_MAX_LISTED = 8
"""Most columns that a message lists."""


def load_scenario_file(path: str | Path, overrides: dict[str, Any] | None = None) -> NamedScenario:
    """Read a scenario file: ``.toml``, or ``.csv`` whose columns have the names of a device's settings.

    The cells of a table are separated by commas, semicolons or tabs.

    Args:
        path: the file.
        overrides: scenario parameters to change, by name, e.g. ``{"region_m": (2000.0, 2000.0)}``.

    Raises:
        ScenarioError: the file is missing or a value in it is wrong; one line.
    """
    path = Path(path)
    if path.suffix.lower() not in (".toml", ".csv"):
        raise ScenarioError(f"{path}: a scenario file ends in .toml or .csv")
    text = read_text(path, ScenarioError, "utf-8-sig")
    data = _from_csv(text, path) if path.suffix.lower() == ".csv" else parse_toml(text, path, ScenarioError)
    data.setdefault("name", _printable(path.stem))
    return make_named_scenario(data, str(path), overrides)


def _printable(stem: str) -> str:
    """Return the name of a file without what a name of a scenario may not hold."""
    return "".join(letter for letter in stem if letter.isprintable())


def _from_csv(text: str, path: Path) -> dict[str, Any]:
    """Convert cells to numbers and booleans where possible; validation reports the others."""
    columns, rows = parse_csv(text, path, ScenarioError)
    _check_columns(columns, path)
    booleans = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}

    def convert(column: str, value: Any) -> Any:
        if column in ("power", "comms"):
            return booleans.get(value.lower(), value)
        if column in ("name", "type", "task"):
            return value
        try:
            return float(value)
        except (ValueError, TypeError):
            return value

    return {"device": [{k: convert(k, v) for k, v in row.items() if v != ""} for row in rows]}


def _check_columns(columns: list[str], path: Path) -> None:
    """Check that the columns are settings of devices, and that none is missing that every device needs."""
    known = ", ".join(Device.model_fields)
    placed = any(set(pair) <= set(columns) for pair in _POSITIONS)
    if not (placed and set(_NEEDED) <= set(columns)):
        there = ", ".join(columns[:_MAX_LISTED]) + ", ..." * (len(columns) > _MAX_LISTED)
        needed = f"{', '.join(_NEEDED)}, and {' or '.join(' and '.join(pair) for pair in _POSITIONS)}"
        raise ScenarioError(f"{path}: has the columns {there}; a device needs {needed}; known: {known}")
    for column in columns:
        if column not in Device.model_fields:
            raise ScenarioError(f"{path}: {column} is not a setting; {suggest(column, Device.model_fields)}")


def _region_corners(file: ScenarioFile) -> list[list[float]] | None:
    """Return the corners of the region, longitudes from -180 to 180."""
    if file.region is None:
        return None
    corners = np.array(file.region)
    if file.device[0].lon is not None:
        corners[:, 0] = wrap_longitudes(corners[:, 0])
    result: list[list[float]] = corners.tolist()
    return result


def scenario_text(scenario: NamedScenario, suffix: str = ".toml") -> str:
    """Return the text of a scenario file, ``.toml`` or ``.csv``, from which an equal scenario is read back.

    Raises:
        ScenarioError: a CSV was asked for, and the scenario has more than devices.
        ArgumentError: a value of the scenario cannot be; one line.
    """
    check_scenario(scenario.params, scenario.layout)
    check_state(scenario.layout, scenario.state)
    file = scenario.file
    devices, depots, uavs = (
        [table.model_dump(exclude_none=True) for table in tables] for tables in (file.device, file.depot, file.uav)
    )
    if suffix == ".toml":
        params = file.params.model_dump(exclude_unset=True)
        optional = {
            "origin": file.origin and list(file.origin),
            "region": _region_corners(file),
            "params": params,
        }
        tables = {"device": devices, "depot": depots, "uav": uavs}
        head = {"name": file.name} | {name: value for name, value in optional.items() if value}
        return tomli_w.dumps(head | {name: table for name, table in tables.items() if table})
    more = {"params": file.params.model_fields_set, "origin": file.origin, "region": file.region}
    if given := [name for name, value in (more | {"depots": depots, "UAVs": uavs}).items() if value]:
        raise ScenarioError(f"{file.name}: a CSV has no place for {' and '.join(given)}; write TOML")
    columns = [field for field in Device.model_fields if any(field in device for device in devices)]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows([{k: str(v).lower() if isinstance(v, bool) else v for k, v in d.items()} for d in devices])
    return text.getvalue()
