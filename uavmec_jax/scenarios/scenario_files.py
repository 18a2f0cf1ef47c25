"""Layout files: inventories in TOML or CSV, read and written."""

import csv
import io
from pathlib import Path
from typing import Any

import tomli_w

from uavmec_jax.errors import LayoutError
from uavmec_jax.files.reading import parse_toml, read_text
from uavmec_jax.files.validation import tuples
from uavmec_jax.scenarios.named_scenario import Inventory, make_inventory
from uavmec_jax.scenarios.schema import Device


def load_inventory(path: str | Path, overrides: dict[str, Any] | None = None) -> Inventory:
    """Read a layout file: ``.toml``, or ``.csv`` with the same column names.

    Args:
        path: the file.
        overrides: scenario parameters by name, e.g. ``{"region_m": (2000.0, 2000.0)}``.

    Raises:
        LayoutError: the file is missing or holds something that does not fit; one line.
    """
    path = Path(path)
    if path.suffix.lower() not in (".toml", ".csv"):
        raise LayoutError(f"{path}: a layout file ends in .toml or .csv")
    text = read_text(path, LayoutError, "utf-8-sig")
    data = _from_csv(text) if path.suffix.lower() == ".csv" else tuples(parse_toml(text, path, LayoutError))
    data.setdefault("name", path.stem)
    return make_inventory(data, str(path), overrides)


def _from_csv(text: str) -> dict[str, Any]:
    """Cells become numbers and truth values where they can; the checks say what is wrong with the others."""
    words = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}

    def cell(column: str, value: Any) -> Any:
        if column in ("power", "comms"):
            return words.get(value.lower(), value)
        if column in ("name", "type", "task"):
            return value
        try:
            return float(value)
        except (ValueError, TypeError):
            return value

    rows = csv.DictReader(io.StringIO(text), skipinitialspace=True, restkey="more cells than columns", restval="")
    return {"device": tuple({k: cell(k, v) for k, v in row.items() if v != ""} for row in rows)}


def inventory_text(inventory: Inventory, suffix: str = ".toml") -> str:
    """The inventory as the text of a layout file, ``.toml`` or ``.csv``, that reads back to an equal one.

    Raises:
        LayoutError: a CSV was asked for, which has no place for parameters or an origin.
    """
    file = inventory.file
    devices = [device.model_dump(exclude_none=True) for device in file.device]
    if suffix == ".toml":
        head = {"name": file.name} | ({"origin": list(file.origin)} if file.origin else {})
        params = file.params.model_dump(exclude_unset=True)
        return tomli_w.dumps(head | ({"params": params} if params else {}) | {"device": devices})
    if file.params.model_fields_set or file.origin:
        raise LayoutError(f"{file.name}: a CSV has no place for params and origin; write TOML")
    columns = [field for field in Device.model_fields if any(field in device for device in devices)]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows([{k: str(v).lower() if isinstance(v, bool) else v for k, v in d.items()} for d in devices])
    return text.getvalue()
