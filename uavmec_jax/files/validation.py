"""Settings from files, checked: strict models, and one clear line for the first value that does not fit."""

import dataclasses
import difflib
import math
from collections.abc import Iterable
from typing import Annotated, Any, Literal, get_args

import pydantic
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, create_model

from_array = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)
"""For fields that are tuples: TOML and JSON know arrays only, and strict models do not convert them."""

Range = Annotated[tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]], from_array]
"""``[low, high]``."""

_BOUNDS = ("gt", "ge", "lt", "le")
_TYPE_TAGS = ("int", "str", "float", "bool")
"""What pydantic adds to the location of an error in a union."""


class StrictModel(BaseModel):
    """A model without unknown keys and without coercion between types; NaN and infinity only where a field allows them."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def model_from_dataclasses(name: str, *declarations: type, leave_out: tuple[str, ...] = ()) -> Any:
    """Make a strict model with the fields, defaults and bounds that dataclasses declare.

    Args:
        name: of the model.
        declarations: dataclasses; the metadata of a field may hold ``gt``, ``ge``, ``lt``, ``le`` or ``choices``.
        leave_out: fields that files do not set.
    """
    fields = {
        field.name: _field(field)
        for declaration in declarations
        for field in dataclasses.fields(declaration)
        if field.name not in leave_out
    }
    return create_model(name, __base__=StrictModel, **fields)


def _field(field: dataclasses.Field) -> Any:
    """Type, bounds and default of one setting."""
    default, bounds = field.default, {k: v for k, v in field.metadata.items() if k in _BOUNDS}
    if "choices" in field.metadata:
        return Literal[field.metadata["choices"]], default
    if isinstance(default, bool):
        return bool, default
    if isinstance(default, int):
        return Annotated[int, Field(**{"ge": 0, **bounds})], default
    if isinstance(default, float):
        bounds = bounds or {"ge": 0}
        return Annotated[float, Field(**bounds, allow_inf_nan=math.isinf(default))], default
    if "items" in field.metadata:  # a tuple of any length
        return Annotated[tuple[Annotated[int, Field(**field.metadata["items"])], ...], from_array], default
    return Range, default


def suggest(word: str, known: Iterable[str]) -> str:
    """Suggest the nearest of the known words, or list them all."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.4)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"


def expectation(error: Any) -> str:
    """Say what would be right, from one of pydantic's errors."""
    message: str = error["msg"]
    return message.replace("Input should be", "it should be").replace("Value error, ", "")


def describe_error(source: str, error: pydantic.ValidationError, root: type[BaseModel], data: Any = None) -> str:
    """Describe the first error in one line: file, field, value, and what would be right.

    Args:
        source: the file or option.
        error: pydantic's.
        root: the model that was validated.
        data: what was validated; names the entry of a list of tables that is at fault.
    """
    first = error.errors()[0]
    if first["type"] == "value_error":
        return f"{source}: {expectation(first)}"
    entry, path = _split_location([part for part in first["loc"] if part not in _TYPE_TAGS], data)
    place = ".".join(map(str, path))
    if first["type"] == "extra_forbidden":
        known = _fields_at(root, first["loc"][:-1])
        hint = suggest(str(first["loc"][-1]), known)
        everything = "" if known == root.model_fields or hint.startswith("known") else f" known: {', '.join(known)}"
        return f"{source}: {entry}{place} is not a setting; {hint}{everything}"
    if first["type"] == "missing":
        return f"{source}: {entry}{place} is missing"
    return f"{source}: {entry}{place} is {first['input']!r}; {expectation(first)}"


def _split_location(location: list[Any], data: Any) -> tuple[str, list[Any]]:
    """Split a location into the entry of a list of tables, counted from 1 and named, and the rest of the way."""
    if not isinstance(data, dict) or len(location) < 2 or not isinstance(location[1], int):
        return "", location
    entry = data[location[0]][location[1]]
    name = entry.get("name", "no name") if isinstance(entry, dict) else entry
    return f"{location[0]} {location[1] + 1} ({name}): ", location[2:]


def _fields_at(root: type[BaseModel], location: tuple[Any, ...]) -> dict[str, Any]:
    """The fields of the model at a location."""
    model: Any = root
    for part in location:
        fields = getattr(model, "model_fields", None)
        if fields is not None:
            model = fields[part].annotation if part in fields else None
        model = next((one for one in get_args(model) if hasattr(one, "model_fields")), model)  # X | None, tuple[X, ...]
    return dict(getattr(model, "model_fields", {}))
