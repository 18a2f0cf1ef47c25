"""Named scenarios: a user's devices with their names, their origin on the map and their present state."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from uavmec_jax.env.checks import check_shape
from uavmec_jax.env.dynamics import State, initial_state
from uavmec_jax.env.layout import Layout
from uavmec_jax.env.params import Params
from uavmec_jax.env.scenario_checks import check_scenario
from uavmec_jax.errors import ScenarioError, StateError
from uavmec_jax.files.validation import validated
from uavmec_jax.scenarios.hops import check_hops
from uavmec_jax.scenarios.inventory import build_layout, check_inventory, depot_tables, device_tables, uav_tables
from uavmec_jax.scenarios.region import (
    Positions,
    check_inside,
    find_positions,
    metres_per_degree,
    region_sides,
    wrap_longitudes,
)
from uavmec_jax.scenarios.schema import ScenarioFile
from uavmec_jax.scenarios.seeds import held_out_draws
from uavmec_jax.scenarios.settings import ParamsSettings, check_ranges


@dataclass(frozen=True)
class NamedScenario:
    """A scenario as its user knows it.

    Attributes:
        file: contents of the scenario file.
        params: Table 1 with the file's changes; the region is the box around the polygon ``region``, or the extent of all
            positions where they are geographic coordinates and the file gives no region.
        layout: the devices, depots and UAVs, in the order of the file.
        state: present state, by default the initial one.
        origin: longitude and latitude of the corner from which metres count; ``None`` if unknown.
        draw_id: seed and numbers of powered and connected devices, which the volume draws depend on.
    """

    file: ScenarioFile
    params: Params
    layout: Layout
    state: State
    origin: tuple[float, float] | None
    draw_id: tuple[int, int, int] = (0, 0, 0)

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return self.file.name

    @property
    def device_names(self) -> list[str]:
        """Names of the devices."""
        return self.file.device_names

    @property
    def depot_names(self) -> list[str]:
        """Names of the depots."""
        return self.file.depot_names

    @property
    def place_names(self) -> list[str]:
        """Names of the places that a UAV can fly to, in the order of actions: the devices, then the depots."""
        return self.file.place_names

    @property
    def uav_names(self) -> list[str]:
        """Names of the UAVs; there is at least one."""
        return self.file.uav_names

    @property
    def region_corners(self) -> Float[np.ndarray, "m 2"] | None:
        """Corners of the region in metres, if the file gives it as a polygon."""
        return find_positions(self.file).corners

    def with_slot_limit(self, slots: int) -> "NamedScenario":
        """Return the scenario with ``max_slots`` where a depot may let UAVs fly on for ever and the file has no limit."""
        has_end = self.params.end == "horizon" or "max_slots" in self.file.params.model_fields_set
        if has_end or not self.depot_names:
            return self
        return replace(self, params=replace(self.params, max_slots=slots))

    def geographic(self, position: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Convert positions ``[..., 2]`` in metres to longitudes, from -180 to 180, and latitudes.

        Raises:
            ScenarioError: the scenario has no origin.
        """
        if self.origin is None:
            raise ScenarioError(f"{self.name}: has no place on the map; give origin = [longitude, latitude]")
        places = np.asarray(position, float) / metres_per_degree(self.origin[1]) + np.array(self.origin)
        return np.stack([wrap_longitudes(np.asarray(places[..., 0])), places[..., 1]], axis=-1)

    def draws(self, count: int) -> Key[Array, " D"]:
        """Return ``count`` volume draws; for a random scenario they are those on which studies evaluate policies."""
        return held_out_draws(*self.draw_id, count)

    def with_failure_price(self, price: float) -> "NamedScenario":
        """Return the scenario with a price on the first failure, in slots of lifetime; see :class:`um.Traffic`.

        Raises:
            StateError: the price is negative or not finite, the traffic of the devices is unknown, or the first failure is
                not the end.
        """
        if not 0 <= price < np.inf:
            raise StateError(f"price is {price}; give slots, a finite number from 0")
        if self.params.end == "horizon":
            raise StateError(f"price is {price:g}, but end is 'horizon', where failures have no price; leave it out")
        if self.layout.traffic is None:
            raise StateError("price is given, but the traffic of these devices is unknown; give a place, e.g. albany")
        traffic = replace(self.layout.traffic, price=jnp.float32(price))
        return replace(self, layout=replace(self.layout, traffic=traffic))


def make_named_scenario(data: dict[str, Any], source: str, overrides: dict[str, Any] | None = None) -> NamedScenario:
    """Make a scenario from the data of a scenario file.

    Args:
        data: contents of the file, as parsed from TOML.
        source: name of the file, for messages.
        overrides: scenario parameters to change, by name.

    Raises:
        ScenarioError: a value is wrong; one line that names it.
    """
    if isinstance(data.get("params", {}), dict):
        data = data | {"params": data.get("params", {}) | (overrides or {})}
    file = validated(ScenarioFile, data, source, ScenarioError)
    try:
        return _build(file)
    except ValueError as error:
        raise ScenarioError(f"{source}: {error}") from None


def _build(file: ScenarioFile) -> NamedScenario:
    check_ranges(file.params, "params.")
    check_inventory(file)
    positions = find_positions(file)
    params = _params(file, positions)
    check_inside(file, positions, params)
    layout = build_layout(file, params, positions)
    check_hops(file, layout.fleet, positions)
    return NamedScenario(file, params, layout, initial_state(params, layout), positions.origin)


def _params(file: ScenarioFile, positions: Positions) -> Params:
    """Return Table 1 with the file's changes; the region holds everything unless the file gives its sides."""
    count, changed = len(file.device), file.params.model_fields_set
    if "n_devices" in changed and file.params.n_devices != count:
        raise ValueError(f"params.n_devices is {file.params.n_devices}, but there are {count} devices; leave it out")
    if "region_m" in changed and file.region is not None:
        raise ValueError("region and params.region_m are both given; leave one of them out")
    settings = file.params.model_dump(exclude={"n_devices"})
    if "region_m" not in changed and (file.region is not None or file.device[0].lon is not None):
        settings["region_m"] = region_sides(positions)
    return Params(n_devices=count, **settings)


def name_scenario(
    layout: Layout, params: Params, name: str, device_names: Sequence[str] | None = None
) -> NamedScenario:
    """Name a random scenario; its devices are ``device 1``, ``device 2``, ... unless ``device_names`` are given.

    What is padding is left out, as are the packs of depots that charge and the power of those that swap.

    Raises:
        ArgumentError: a parameter or a value of the layout is out of range, or there is not one name per device; one line.
    """
    check_scenario(params, layout)
    names = device_names or [f"device {number}" for number in range(1, layout.n_devices + 1)]
    check_shape("device_names", names, (layout.n_devices,), "one per device")
    settings = {field: getattr(params, field) for field in ParamsSettings.model_fields if field != "n_devices"}
    changed = {field: value for field, value in settings.items() if value != getattr(Params(), field)}
    arrays = jax.tree.map(np.asarray, layout)
    depots = depot_tables(arrays.depots)
    tables = {"device": device_tables(arrays, names), "depot": depots, "uav": uav_tables(arrays.fleet, params, depots)}
    return make_named_scenario({"name": name, "params": changed} | tables, name)
