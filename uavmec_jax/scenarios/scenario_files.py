"""Read and write scenario files: named scenarios in TOML or CSV."""

import csv
import io
from pathlib import Path
from typing import Any

import tomli_w

from uavmec_jax.errors import ScenarioError
from uavmec_jax.files.parsing import parse_toml
from uavmec_jax.files.reading import read_text
from uavmec_jax.scenarios.named_scenario import NamedScenario, make_named_scenario
from uavmec_jax.scenarios.schema import Device


def load_scenario_file(path: str | Path, overrides: dict[str, Any] | None = None) -> NamedScenario:
    """Read a scenario file: ``.toml``, or ``.csv`` whose columns have the names of a device's settings.

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
    data = _from_csv(text) if path.suffix.lower() == ".csv" else parse_toml(text, path, ScenarioError)
    data.setdefault("name", path.stem)
    return make_named_scenario(data, str(path), overrides)


def _from_csv(text: str) -> dict[str, Any]:
    """Convert cells to numbers and booleans where possible; validation reports the others."""
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

    rows = csv.DictReader(io.StringIO(text), skipinitialspace=True, restkey="more cells than columns", restval="")
    return {"device": [{k: convert(k, v) for k, v in row.items() if v != ""} for row in rows]}


def scenario_text(scenario: NamedScenario, suffix: str = ".toml") -> str:
    """Return the text of a scenario file, ``.toml`` or ``.csv``, from which an equal scenario is read back.

    Raises:
        ScenarioError: a CSV was asked for, and the scenario has more than devices.
    """
    file = scenario.file
    devices, depots, uavs = (
        [table.model_dump(exclude_none=True) for table in tables] for tables in (file.device, file.depot, file.uav)
    )
    if suffix == ".toml":
        params = file.params.model_dump(exclude_unset=True)
        optional = {
            "origin": file.origin and list(file.origin),
            "region": file.region and [list(corner) for corner in file.region],
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
