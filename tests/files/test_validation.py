"""Settings from files: strict models made of dataclasses, and errors in one line."""

import math
from dataclasses import dataclass, field
from typing import Annotated

import pydantic
import pytest
from pydantic import Field

from uavmec_jax.files.validation import (
    StrictModel,
    describe_error,
    expectation,
    from_array,
    model_from_dataclasses,
    suggest,
)


class Engine(StrictModel):
    power_w: Annotated[float, Field(gt=0)] = 1.0
    fuel: str = "petrol"


class Seat(StrictModel):
    name: Annotated[str, Field(min_length=1)]
    width_m: Annotated[float, Field(gt=0, le=2)] = 0.5


class Cabin(StrictModel):
    seat: Annotated[tuple[Seat, ...], from_array] = ()
    lamps: Annotated[tuple[str, ...], from_array] = ()
    bags: Annotated[tuple[int, ...], Field(min_length=2), from_array] = (1, 2)


class Car(StrictModel):
    wheels: Annotated[int, Field(ge=3)]
    mirrors: int | str = 2
    engine: Engine = Engine()
    spare_engine: Engine | None = None
    origin: Annotated[tuple[float, Annotated[float, Field(le=90)]] | None, from_array] = None
    seat: Annotated[tuple[Seat, ...], from_array] = ()
    doors: dict[str, Seat] = Field(default_factory=dict)
    routes: Annotated[tuple[Annotated[tuple[float, ...], from_array], ...], from_array] = ()
    cabin: Cabin = Cabin()

    @pydantic.model_validator(mode="after")
    def _check_seats(self):
        if len(self.seat) > 3:
            raise ValueError("holds more than 3 seats")
        return self


ERRORS = {
    "missing": ({}, "car.toml: wheels is missing"),
    "out of range": ({"wheels": 2}, "car.toml: wheels is 2; it should be greater than or equal to 3"),
    "type": ({"wheels": "4"}, "car.toml: wheels is '4'; it should be a whole number"),
    "infinite": ({"wheels": 4, "engine": {"power_w": math.inf}}, "engine.power_w is inf; it should be a finite number"),
    "union": ({"wheels": 4, "mirrors": 2.5}, "car.toml: mirrors is 2.5; it should be a whole number"),
    "key": ({"wheels": 4, "engin": {}}, "car.toml: engin is not a setting; did you mean 'engine'?"),
    "key called like a type": (
        {"wheels": 4, "engine": {"float": 1.0}},
        "car.toml: engine.float is not a setting; did you mean 'fuel'? known: power_w, fuel",
    ),
    "unlike key": (
        {"wheels": 4, "q": 1},
        "car.toml: q is not a setting; known: wheels, mirrors, engine, spare_engine, origin, seat, doors, routes, cabin",
    ),
    "nested key": (
        {"wheels": 4, "engine": {"powr_w": 1.0}},
        "car.toml: engine.powr_w is not a setting; did you mean 'power_w'? known: power_w, fuel",
    ),
    "key of an optional table": (
        {"wheels": 4, "spare_engine": {"full": "oil"}},
        "car.toml: spare_engine.full is not a setting; did you mean 'fuel'? known: power_w, fuel",
    ),
    "nested value": (
        {"wheels": 4, "engine": {"power_w": 0.0}},
        "car.toml: engine.power_w is 0.0; it should be greater than 0",
    ),
    "value in an array": (
        {"wheels": 4, "origin": [9.0, 95.0]},
        "car.toml: origin: item 2 is 95.0; it should be less than or equal to 90",
    ),
    "value in a list of tables": (
        {"wheels": 4, "seat": [{"name": "left"}, {"name": "right", "width_m": 3.0}]},
        "car.toml: seat 2 (right): width_m is 3.0; it should be less than or equal to 2",
    ),
    "missing in a list of tables": (
        {"wheels": 4, "seat": [{"width_m": 1.0}]},
        "car.toml: seat 1 (no name): name is missing",
    ),
    "key in a list of tables": (
        {"wheels": 4, "seat": [{"name": "left", "width": 1.0}]},
        "car.toml: seat 1 (left): width is not a setting; did you mean 'width_m'? known: name, width_m",
    ),
    "value in a table by name": (
        {"wheels": 4, "doors": {"left": {"name": "a", "width_m": 3.0}}},
        "car.toml: doors.left.width_m is 3.0; it should be less than or equal to 2",
    ),
    "key in a table by name": (
        {"wheels": 4, "doors": {"left": {"name": "a", "width": 3.0}}},
        "car.toml: doors.left.width is not a setting; did you mean 'width_m'? known: name, width_m",
    ),
    "item of a list in a list": (
        {"wheels": 4, "routes": [[1.0, 2.0], [1.0, math.nan]]},
        "car.toml: routes: item 2: item 2 is nan; it should be a finite number",
    ),
    "table of a list inside a table": (
        {"wheels": 4, "cabin": {"seat": [{"name": "a"}, {"name": "b", "width": 1.0}]}},
        "car.toml: cabin.seat 2 (b): width is not a setting; did you mean 'width_m'? known: name, width_m",
    ),
    "item inside a table": (
        {"wheels": 4, "cabin": {"lamps": ["a", 3]}},
        "car.toml: cabin.lamps: item 2 is 3; it should",
    ),
    "empty text": (
        {"wheels": 4, "seat": [{"name": ""}]},
        "car.toml: seat 1 (): name is ''; it should have at least 1 char",
    ),
    "too few": ({"wheels": 4, "cabin": {"bags": [1]}}, "cabin.bags is (1,); it should have at least 2 items, not 1"),
    "no table in a list of tables": ({"wheels": 4, "seat": [3]}, "car.toml: seat 1 (3): is 3; it should be"),
    "validator": ({"wheels": 4, "seat": [{"name": "a"}] * 4}, "car.toml: holds more than 3 seats"),
    "no table": ([1], "car.toml: is [1]; it should be a table"),
}


@pytest.mark.parametrize(("data", "message"), ERRORS.values(), ids=ERRORS)
def test_an_error_is_one_line_that_says_what_would_be_right(data, message):
    with pytest.raises(pydantic.ValidationError) as error:
        Car.model_validate(data)
    description = describe_error("car.toml", error.value, Car, data)
    assert description.startswith("car.toml: ")
    assert message in description
    assert "\n" not in description


def test_without_the_data_a_table_of_a_list_has_its_number():
    with pytest.raises(pydantic.ValidationError) as error:
        Car.model_validate({"wheels": 4, "seat": [{"name": "left", "width_m": 3.0}]})
    assert describe_error("x", error.value, Car) == "x: seat 1: width_m is 3.0; it should be less than or equal to 2"
    assert expectation(error.value.errors()[0]) == "it should be less than or equal to 2"


def test_arrays_become_tuples():
    car = Car.model_validate({"wheels": 4, "origin": [9.0, 50.0], "seat": [{"name": "left"}]})
    assert car.origin == (9.0, 50.0)
    assert car.seat == (Seat(name="left"),)


def test_models_are_strict_and_frozen():
    with pytest.raises(pydantic.ValidationError, match="frozen"):
        Engine().fuel = "oil"
    with pytest.raises(pydantic.ValidationError, match="valid string"):
        Engine(fuel=3)


@dataclass
class Motion:
    speed: float = field(default=5.0, metadata={"gt": 0, "unit": "m/s"})
    limit: float = math.inf
    laps: int = field(default=3, metadata={"le": 9})
    range_m: tuple[float, float] = (1.0, 2.0)
    forward: bool = True


@dataclass
class Team:
    colour: str = field(default="red", metadata={"choices": ("red", "blue")})
    ages: tuple[int, ...] = field(default=(20,), metadata={"items": {"ge": 18}})
    secret: int = 0


def test_a_model_has_the_fields_and_defaults_of_its_dataclasses():
    model = model_from_dataclasses("Settings", Motion, Team, leave_out=("secret",))
    assert model.__name__ == "Settings"
    assert model().model_dump() == {
        "speed": 5.0,
        "limit": math.inf,
        "laps": 3,
        "range_m": (1.0, 2.0),
        "forward": True,
        "colour": "red",
        "ages": (20,),
    }
    settings = model.model_validate({"range_m": [0.5, 4.0], "ages": [30, 40], "colour": "blue", "limit": 2.0})
    assert (settings.range_m, settings.ages, settings.colour, settings.limit) == ((0.5, 4.0), (30, 40), "blue", 2.0)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"speed": 0.0}, "speed is 0.0; it should be greater than 0"),
        ({"speed": math.inf}, "speed is inf; it should be a finite number"),
        ({"limit": -1.0}, "limit is -1.0; it should be greater than or equal to 0"),
        ({"laps": 10}, "laps is 10; it should be less than or equal to 9"),
        ({"laps": -1}, "laps is -1; it should be greater than or equal to 0"),
        ({"laps": True}, "laps is True; it should be a whole number"),
        ({"range_m": [-1.0, 2.0]}, "range_m: item 1 is -1.0; it should be greater than or equal to 0"),
        ({"forward": 1}, "forward is 1; it should be true or false"),
        ({"colour": "green"}, "colour is 'green'; it should be 'red' or 'blue'"),
        ({"ages": [20, 17]}, "ages: item 2 is 17; it should be greater than or equal to 18"),
        ({"secret": 1}, "secret is not a setting; did you mean 'speed'?"),
    ],
)
def test_a_model_has_the_bounds_of_its_dataclasses(data, message):
    model = model_from_dataclasses("Settings", Motion, Team, leave_out=("secret",))
    with pytest.raises(pydantic.ValidationError) as error:
        model.model_validate(data)
    assert describe_error("--set", error.value, model, data) == f"--set: {message}"


def test_suggestions():
    assert suggest("gama", ["gamma", "tau"]) == "did you mean 'gamma'?"
    assert suggest("xyz", iter(["gamma", "tau"])) == "known: gamma, tau"
    assert suggest("x", []) == "known: "
