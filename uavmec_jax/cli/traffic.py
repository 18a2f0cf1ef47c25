"""Commands about evacuation traffic."""

import os
import re
from pathlib import Path
from typing import Any

import click

from uavmec_jax.cli.common import InputError, assignments, command_line, print_json, print_line
from uavmec_jax.cli.options import MAX_DEVICES, MAX_SEED, json_option, set_option
from uavmec_jax.cli.types import LocalPath, NameOrPath, WholeNumber, refuse_given
from uavmec_jax.errors import printable

_TABLES = ("network", "demand", "simulation", "devices")
"""Tables of a place that ``--set`` changes."""

_PLACEMENT = ("count", "corridor_share", "span_m")
"""Settings of the table ``devices`` that place devices which no file lists."""


@click.group()
def traffic() -> None:
    """Simulate evacuations, and show how much traffic each device sees.

    \b
    uavmec traffic show albany                    a place that ships with the package
    uavmec traffic build --osm area.osm.gz        any place, from an OpenStreetMap extract (needs SUMO)
    uavmec traffic show area.npz --figure map.png
    """


@traffic.command()
@click.argument("place", required=False, type=NameOrPath())
@click.option("--osm", type=LocalPath(), help="OpenStreetMap extract: .osm, .osm.gz or .osm.bz2.")
@click.option("--bbox", metavar="W,S,E,N", help="Bounding box to cut from the extract, in degrees.")
@click.option("--net", type=LocalPath(), help="SUMO network, .net.xml.")
@click.option("--devices", type=LocalPath(), help="TOML file with a [[device]] table for each device.")
@click.option(
    "--origin", "origins", multiple=True, metavar="ROAD", help="Road where trips start (default: residential roads)."
)
@click.option(
    "--exit", "exits", multiple=True, metavar="NAME[=WEIGHT]", help="Where trips end (default: ends of highways)."
)
@click.option("--vehicles", type=WholeNumber(1, 1_000_000), help="Number of vehicles to evacuate.")
@click.option("--seeds", type=WholeNumber(1, 1000), help="Number of simulations to average.")
@set_option(help="Override any setting, e.g. --set demand.warm_up_s=300.0.")
@click.option("--out", type=LocalPath(), help="File of the evacuation (default: <place>.npz).")
@json_option
def build(
    place: str | None,
    osm: Path | None,
    bbox: str | None,
    net: Path | None,
    devices: Path | None,
    origins: tuple[str, ...],
    exits: tuple[str, ...],
    vehicles: int | None,
    seeds: int | None,
    settings: tuple[str, ...],
    out: Path | None,
    as_json: bool,
) -> None:
    """Simulate the evacuation of PLACE, a TOML file or a place that ships with the package, or of a map or network."""
    if sum(source is not None for source in (place, osm, net)) != 1:
        raise InputError("give one of PLACE, --osm FILE and --net FILE")
    if bbox is not None and osm is None:
        raise InputError(f"--bbox {bbox}: cuts an OpenStreetMap extract; give --osm too")
    from rich.text import Text

    from uavmec_jax.cli.console import new_console
    from uavmec_jax.traffic.build import build_evacuation
    from uavmec_jax.traffic.place import load_place, make_place

    changes = _changes(settings, devices, origins=origins, exits=exits, vehicles=vehicles, seeds=seeds)
    if place is not None:
        resolved, folder = load_place(place, changes)
    else:
        source = osm or net
        assert source is not None
        network = {"osm" if osm else "net": str(source.absolute())} | ({"bbox": _box(bbox)} if bbox else {})
        name = re.sub("[^A-Za-z0-9]+", "-", source.name.split(".")[0]).strip("-")[:80] or "place"
        for setting in changes.pop("network", {}):
            raise InputError(f"--set network.{setting}: {'--osm' if osm else '--net'} gives the network; leave it out")
        resolved, folder = make_place({"name": name, "network": network} | changes, str(source)), Path()
    for setting in changes.get("devices", {}) if resolved.device else ():
        if setting in _PLACEMENT:
            raise InputError(f"--set devices.{setting}: is for devices that no file lists, and one does; leave it out")
    target = _target(out or Path(f"{resolved.name}.npz"))
    with new_console(stderr=True).status("starting") as status:
        evacuation = build_evacuation(
            resolved, folder, command=command_line(), on_progress=lambda line: status.update(Text(line))
        )
    evacuation.save(target)
    _print(evacuation, str(target), as_json)


@traffic.command()
@click.argument("source", type=NameOrPath())
@click.option("--figure", type=LocalPath(), help="Draw the road map (.png, .svg or .pdf).")
@click.option("--animation", type=LocalPath(), help="Draw one evacuation slot by slot (.gif).")
@click.option(
    "--policy",
    type=NameOrPath(),
    default="earliest-deadline",
    help="Name or file of the policy to animate (default: earliest-deadline).",
)
@click.option(
    "--powered",
    type=WholeNumber(0, MAX_DEVICES),
    default=8,
    help="Number of devices with grid power to animate (default: 8).",
)
@click.option(
    "--connected",
    type=WholeNumber(0, MAX_DEVICES),
    default=6,
    help="Number of devices with communication to animate (default: 6).",
)
@click.option(
    "--seed", type=WholeNumber(0, MAX_SEED), default=0, help="Seed of hardware, power, communication and task volumes."
)
@json_option
def show(
    source: str,
    figure: Path | None,
    animation: Path | None,
    policy: str,
    powered: int,
    connected: int,
    seed: int,
    as_json: bool,
) -> None:
    """Show the devices and their traffic in SOURCE, the file of an evacuation or a place that ships with the package."""
    if animation is None:
        refuse_given("is only for --animation", "policy", "powered", "connected", "seed")
    from uavmec_jax.traffic.evacuation import load_evacuation

    evacuation = load_evacuation(source)
    for path, endings in ((figure, (".png", ".svg", ".pdf")), (animation, (".gif",))):
        if path is not None and path.suffix.lower() not in endings:
            raise InputError(f"{path}: ends in {path.suffix!r}; it should end in {' or '.join(endings)}")
    written = []
    if figure is not None:
        from uavmec_jax.reporting.canvas import save
        from uavmec_jax.reporting.road_map import map_figure

        save(map_figure(evacuation), figure)
        written.append(figure)
    if animation is not None:
        from uavmec_jax.reporting.animation import save_animation
        from uavmec_jax.scenarios.load import load_scenario
        from uavmec_jax.scenarios.policies import load_policy

        chosen = load_policy(policy)
        scenario = load_scenario(place=source, powered=powered, connected=connected, seed=seed)
        title = f"{evacuation.name}, {Path(policy).name}"
        save_animation(animation, evacuation, scenario.params, scenario.layout, chosen, scenario.draws(1)[0], title)
        written.append(animation)
    _print(evacuation, source, as_json)
    for path in written:
        print_line(printable(f"File: {path}"), err=as_json)


def _print(evacuation: Any, source: str, as_json: bool) -> None:
    """Print the devices of an evacuation as a table or as JSON."""
    from uavmec_jax.cli.console import new_console
    from uavmec_jax.reporting.evacuation import evacuation_data, evacuation_lines, evacuation_table

    if as_json:
        print_json(evacuation_data(evacuation))
        return
    console = new_console()
    console.print_heading(evacuation.name, evacuation.meta["description"])
    console.print_table(evacuation_table(evacuation))
    for line in evacuation_lines(evacuation):
        console.print(line, highlight=False)
    console.print(f"File: {source}", highlight=False, soft_wrap=True)


def _changes(
    settings: tuple[str, ...],
    devices: Path | None,
    *,
    origins: tuple[str, ...],
    exits: tuple[str, ...],
    vehicles: int | None,
    seeds: int | None,
) -> dict[str, Any]:
    """Return the changes that the options make to a place, as tables of its file."""
    from uavmec_jax.traffic.sites import load_sites

    demand = {"origins": origins or None, "exits": _exits(exits) or None, "vehicles": vehicles}
    tables: dict[str, dict[str, Any]] = {"demand": demand, "simulation": {"seeds": seeds}}
    changes: dict[str, Any] = {
        table: {name: value for name, value in options.items() if value is not None}
        for table, options in tables.items()
    }
    for dotted, value in assignments(settings).items():
        table, _, name = dotted.partition(".")
        if table not in _TABLES or not name:
            raise InputError(
                f"--set {dotted}: name a table and a setting, e.g. demand.vehicles=2000; tables: {', '.join(_TABLES)}"
            )
        if name in changes.get(table, {}):
            raise InputError(f"--set {dotted}: an option gives it too; leave one of them out")
        changes.setdefault(table, {})[name] = value
    if devices is not None:
        changes["device"] = load_sites(devices)
    return changes


def _exits(texts: tuple[str, ...]) -> dict[str, Any]:
    """Parse the options ``--exit``."""
    weights = dict(map(_exit, texts))
    if len(weights) < len(texts):
        names = [_exit(text)[0] for text in texts]
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"--exit {twice}: is given twice; give it once")
    return weights


def _exit(text: str) -> tuple[str, Any]:
    """Parse ``NAME`` or ``NAME=WEIGHT``."""
    name, equals, weight = text.rpartition("=")
    if not equals:
        return text, 1.0
    try:
        return name, float(weight)
    except ValueError:
        raise InputError(f"--exit {text}: the weight is {weight!r}; give NAME=WEIGHT with a number above 0") from None


def _box(text: str) -> tuple[float, ...]:
    """Parse the bounding box ``W,S,E,N``."""
    try:
        sides = tuple(float(side) for side in text.split(","))
    except ValueError:
        sides = ()
    if len(sides) != 4:
        raise InputError(f"--bbox {text}: give west,south,east,north in degrees, e.g. 9.68,50.85,9.74,50.885")
    return sides


def _target(path: Path) -> Path:
    """Check, before anything is simulated, that the file can be written."""
    if path.suffix != ".npz":
        raise InputError(f"--out {path}: ends in {path.suffix!r}; it should end in .npz")
    if not os.path.isdir(path.parent) or not os.access(path.parent, os.W_OK):
        raise InputError(f"--out {path}: {path.parent} is not a folder that can be written to")
    if os.path.lexists(path) and not os.path.isfile(path):
        raise InputError(f"--out {path}: is not a regular file, and is not replaced; give another name")
    return path
