"""Settings in files: strict models made from the dataclasses that declare them, and one clear line for what does not fit."""

import dataclasses
import difflib
import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

import pydantic
from pydantic import BaseModel, ConfigDict, Field, create_model


class Strict(BaseModel):
    """No unknown keys, no coercion between types, no NaN or infinity unless a field allows it."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _field(field: dataclasses.Field) -> Any:
    """Type and bounds of one setting, from its default and its metadata."""
    default, bounds = field.default, {k: v for k, v in field.metadata.items() if k in ("gt", "ge", "lt", "le")}
    if "choices" in field.metadata:
        return Literal[field.metadata["choices"]], default
    if isinstance(default, bool):
        return bool, default
    if isinstance(default, int):
        return Annotated[int, Field(**{"ge": 0, **bounds})], default
    if isinstance(default, float):
        infinite = math.isinf(default)
        return Annotated[
            float, Field(**{**({"ge": 0} if not bounds else {}), **bounds}, allow_inf_nan=infinite)
        ], default
    if field.name == "hidden":
        return tuple[Annotated[int, Field(ge=1, le=4096)], ...], default
    return tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]], default


def settings_model(name: str, *declarations: type, leave_out: tuple[str, ...] = ()) -> Any:
    """A strict model with the fields, defaults and bounds of pytree dataclasses."""
    fields = {
        field.name: _field(field)
        for declaration in declarations
        for field in dataclasses.fields(declaration)
        if field.name not in leave_out
    }
    return create_model(name, __base__=Strict, **fields)


def tuples(table: Mapping[str, Any]) -> dict[str, Any]:
    """A table of a file with its arrays as tuples, which is what the strict models want."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in table.items()}


def nearest(word: str, words: Any) -> str:
    """A hint: the nearest of the known words, or all of them."""
    close = difflib.get_close_matches(word, list(words), n=1, cutoff=0.4)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(words)}"


def wanted(error: Any) -> str:
    """What would be right, from one of pydantic's errors."""
    message: str = error["msg"]
    return message.replace("Input should be", "it should be").replace("Value error, ", "")


def one_line(source: str, error: pydantic.ValidationError, root: type[BaseModel]) -> str:
    """The first problem as one line: file, field, value, and what would be right."""
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"] if part not in ("int", "str", "float", "bool"))
    if first["type"] == "value_error":
        return f"{source}: {wanted(first)}"
    if first["type"] == "extra_forbidden":
        parent: Any = root
        for part in first["loc"][:-1]:
            parent = parent.model_fields[part].annotation if part in getattr(parent, "model_fields", {}) else None
            parent = next((one for one in get_args(parent) if hasattr(one, "model_fields")), parent)  # X | None
        known = getattr(parent, "model_fields", {})
        hint = nearest(str(first["loc"][-1]), known)
        everything = "" if parent is root or hint.startswith("known") else f" known: {', '.join(known)}"
        return f"{source}: {place} is not a setting; {hint}{everything}"
    if first["type"] == "missing":
        return f"{source}: {place} is missing"
    return f"{source}: {place} is {first['input']!r}; {wanted(first)}"
