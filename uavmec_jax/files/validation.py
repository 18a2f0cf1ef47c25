"""Validation of settings from files: strict pydantic models, and errors described in one line."""

import dataclasses
import difflib
import math
import re
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import pydantic
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, create_model
from pydantic_core import PydanticCustomError

from uavmec_jax.errors import UserError

from_array = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)
"""Converts lists for fields that are tuples: TOML and JSON have arrays only, and strict models do not convert them."""

LARGEST = 1e12
"""Largest size of a number: far beyond any quantity in SI units, and far from overflow in float32."""

LEAST_SIZE = 1e-12
"""Smallest size of a number that is not 0: in float32, what is much closer to 0 is 0, and divides to infinity."""

LARGEST_WHOLE = 2**31 - 1
"""Largest whole number where nothing else is said: that of int32."""


def _check_size(value: float) -> float:
    if LARGEST < abs(value) < math.inf:
        raise PydanticCustomError("too_large", f"Input should be at most {LARGEST:g} in size")
    if 0 < abs(value) < LEAST_SIZE:
        raise PydanticCustomError("too_small", f"Input should be 0, or at least {LEAST_SIZE:g} in size")
    return value


usual_size = AfterValidator(_check_size)
"""Checks that a number is 0, infinite where that is allowed, or of a size from :data:`LEAST_SIZE` to :data:`LARGEST`."""

_End = Annotated[float, Field(ge=0), usual_size]
Range = Annotated[tuple[_End, _End], from_array]
"""``[low, high]``."""


def _check_printable(text: str) -> str:
    if not text.isprintable():
        raise PydanticCustomError("printable", "Input should be one line of characters that can be printed")
    return text


PrintableText = Annotated[str, Field(max_length=1000), AfterValidator(_check_printable)]
"""One line of text without characters that a terminal would obey."""

PrintableName = Annotated[str, Field(min_length=1, max_length=80), AfterValidator(_check_printable)]
"""Name of a device, a UAV, a place."""

_Model = TypeVar("_Model", bound=BaseModel)

_BOUNDS = ("gt", "ge", "lt", "le")
_TYPE_TAG = re.compile(r"int|str|float|bool|(constrained-|tuple\[|dict\[|list\[|function-).*", re.DOTALL)
"""Parts that pydantic adds to the location of an error in a union."""

_WORDS = {
    "boolean": "true or false",
    "tuple": "an array",
    "list": "an array",
    "dictionary": "a table",
    "integer": "a whole number",
    "number": "a number",
    "string": "text",
}
_KINDS = re.compile(rf"\ba valid ({'|'.join(_WORDS)})\b( or instance of \w+)?")
"""What pydantic calls Python's types, and the words of TOML that users know."""

_SUBJECT = re.compile(r"\b(Input|String|Tuple|List|Dictionary) should")
"""What pydantic calls a value that should be something else."""


class StrictModel(BaseModel):
    """A model that forbids unknown keys and conversions between types, and NaN and infinity unless a field allows them."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def model_from_dataclasses(name: str, *declarations: type, leave_out: tuple[str, ...] = ()) -> Any:
    """Make a strict model with the fields, defaults and bounds of dataclasses.

    Numbers have to be at least 0 unless their field has bounds of its own, and whole ones at most :data:`LARGEST_WHOLE`.
    Those that are not whole have a :data:`usual_size`.

    Args:
        name: name of the model.
        declarations: dataclasses. The metadata of a field may hold bounds (``gt``, ``ge``, ``lt``, ``le``), the allowed
            values (``choices``), or the bounds of the integers in a tuple (``items``) and of its length (``max_length``).
        leave_out: fields that files may not set.
    """
    fields = {
        field.name: _field(field)
        for declaration in declarations
        for field in dataclasses.fields(declaration)
        if field.name not in leave_out
    }
    return create_model(name, __base__=StrictModel, **fields)


def _field(field: dataclasses.Field) -> Any:
    """Return the type, with its bounds, and the default of one setting, as pydantic declares a field."""
    default, bounds = field.default, {k: v for k, v in field.metadata.items() if k in _BOUNDS}
    if "choices" in field.metadata:
        return Literal[field.metadata["choices"]], default
    if isinstance(default, bool):
        return bool, default
    if isinstance(default, int):
        return Annotated[int, Field(**{"ge": 0, "le": LARGEST_WHOLE, **bounds})], default
    if isinstance(default, float):
        return Annotated[float, Field(**(bounds or {"ge": 0}), allow_inf_nan=math.isinf(default)), usual_size], default
    if "items" in field.metadata:
        length = Field(max_length=field.metadata.get("max_length"))
        return Annotated[tuple[Annotated[int, Field(**field.metadata["items"])], ...], length, from_array], default
    return Range, default


def validated(
    model: type[_Model], data: Any, source: object, error: type[UserError], *, strict: bool | None = None
) -> _Model:
    """Return data from outside as a model; ``source`` names them in messages.

    Raises:
        UserError: a value is missing, unknown or not what it should be; of the type ``error``, one line.
    """
    try:
        return model.model_validate(data, strict=strict)
    except pydantic.ValidationError as problem:
        raise error(describe_error(str(source), problem, model, data)) from None


def suggest(word: str, options: Iterable[str]) -> str:
    """Return a hint for an unknown word: the most similar option, or all options if none is similar."""
    options = list(options)
    close = difflib.get_close_matches(word, options, n=1, cutoff=0.4)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(options)}"


def expectation(error: Any) -> str:
    """Return what one of pydantic's errors says that the value should be."""
    message = _SUBJECT.sub("it should", error["msg"], count=1)
    message = _KINDS.sub(lambda kind: _WORDS[kind[1]], message, count=1)
    return message.replace(" after validation", "").replace("Value error, ", "")


def describe_error(source: str, error: pydantic.ValidationError, model: type[BaseModel], data: Any = None) -> str:
    """Describe the first of pydantic's errors in one line: source, field, value, and what would be right.

    Args:
        source: the file or option that the data come from.
        error: raised by the validation.
        model: the model that was validated.
        data: the data; if they are given, an error in a list of tables names the table.
    """
    first = _first_of(error)
    if first["type"] == "value_error":
        return f"{source}: {expectation(first)}"
    location = _without_tags(first)
    if first["type"] == "extra_forbidden":  # it may be called like a tag
        location = [*_without_tags({**first, "loc": first["loc"][:-1]}), first["loc"][-1]]
    subject = f"{source}: {_in_words(location, model, data)}".rstrip()
    if first["type"] == "extra_forbidden":
        fields = _fields_at(model, first["loc"][:-1])
        hint = suggest(str(first["loc"][-1]), fields)
        options = "" if fields == model.model_fields or hint.startswith("known") else f" known: {', '.join(fields)}"
        return f"{subject} is not a setting; {hint}{options}"
    if first["type"] == "missing":
        return f"{subject} is missing"
    return f"{subject} is {first['input']!r}; {expectation(first)}"


def _first_of(error: pydantic.ValidationError) -> Any:
    """Return the first of pydantic's errors; of those about one value of a union, that which is deepest inside it.

    The others say that the value should be of another type, such as a list where a table is given.
    """
    errors = error.errors()
    whole = _without_tags(errors[0])
    same = [one for one in errors if _without_tags(one)[: len(whole)] == whole]
    return max(same, key=lambda one: len(_without_tags(one)))


def _without_tags(error: Any) -> list[Any]:
    """Return the location of an error without the parts that pydantic adds in a union."""
    return [part for part in error["loc"] if not (isinstance(part, str) and _TYPE_TAG.fullmatch(part))]


def _in_words(location: list[Any], model: type[BaseModel], data: Any) -> str:
    """Return a location in words: tables of a list and items are counted from 1, and tables named, where data are given."""
    words = ""
    for depth, part in enumerate(location):
        if not isinstance(part, int):
            inside = ": " if depth and isinstance(location[depth - 1], int) else "."
            words += f"{inside}{part}" if words and not words.endswith(": ") else str(part)
        elif _fields_at(model, location[:depth]):  # of a list of tables
            words += f" {part + 1}{_name_at(data, location[: depth + 1])}: "
        else:
            words += f": item {part + 1}" if words and not words.endswith(": ") else f"item {part + 1}"
    return words


def _name_at(data: Any, location: list[Any]) -> str:
    """Return the name of a table in brackets, or what stands in its place; empty if the data have nothing there."""
    for part in location:
        try:
            data = data[part]
        except (LookupError, TypeError):
            return ""
    return f" ({data.get('name', 'no name') if isinstance(data, dict) else data})"


def _fields_at(model: Any, location: Sequence[Any]) -> dict[str, Any]:
    """Return the fields of the model at a location inside ``model``; empty if there is no model."""
    for part in location:
        if isinstance(part, int):  # all tables of a list have the same model
            continue
        if get_origin(model) is dict:  # and so have all tables by name
            model = get_args(model)[1]
            continue
        fields = getattr(model, "model_fields", None)
        if fields is not None:
            model = fields[part].annotation if part in fields else None
        arguments = () if get_origin(model) is dict else get_args(model)  # of X | None or tuple[X, ...]
        model = next((argument for argument in arguments if hasattr(argument, "model_fields")), model)
    return dict(getattr(model, "model_fields", {}))
