"""What a simulated evacuation leaves: one small file, read without SUMO by training, evaluation and figures."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from uavmec_jax.errors import TrafficError
from uavmec_jax.files.archives import read_checked, write_checked
from uavmec_jax.files.validation import suggest
from uavmec_jax.traffic.place import PLACES, shipped_places

SCHEMA = 1
"""Version of the file."""

HIGH_TRAFFIC = 0.4
"""Weight from which a device counts as in high traffic; in the places that ship with the package nobody is near it."""


@dataclass(frozen=True)
class Evacuation:
    """A place, its devices, and how dense the traffic near each is.

    Attributes:
        meta: ``place``, ``description``, ``names`` of the devices, ``roads`` by id, ``window_s``, ``mean_s``,
            ``mean_windows``, ``radius_m``; and how it was made: ``vehicles``, ``seeds``, ``loaded``, ``unfinished``,
            ``teleports``, ``cut_off``, ``warnings``, ``sumo``, ``network_sha256``, ``command``, ``settings``.
        position: ``[n, 2]`` m in the network.
        density: ``[n]`` vehicles per km and lane near each device, mean over ``mean_s`` of the evacuation and over the seeds.
        density_spread: ``[n]`` standard deviation of the same over the seeds.
        weight: ``[n]`` in [0, 1], density over that of the busiest device.
        window_weight: ``[W, n]`` in [0, 1], the same in each window, over the busiest device's busiest window.
        road_shape: ``[P, 2]`` m, the corners of all roads one after the other.
        road_corners: ``[R]`` how many corners each road has.
        road_lanes: ``[R]``.
        road_density: ``[W, R]`` vehicles per km and lane, mean over the seeds.
    """

    meta: dict[str, Any]
    position: np.ndarray
    density: np.ndarray
    density_spread: np.ndarray
    weight: np.ndarray
    window_weight: np.ndarray
    road_shape: np.ndarray
    road_corners: np.ndarray
    road_lanes: np.ndarray
    road_density: np.ndarray

    @property
    def name(self) -> str:
        """Of the place."""
        return str(self.meta["place"])

    @property
    def n_devices(self) -> int:
        """How many devices there are."""
        return len(self.weight)

    @property
    def busy(self) -> np.ndarray:
        """``[n]`` bool: devices in high traffic, those that see at least :data:`HIGH_TRAFFIC` of the busiest's."""
        return np.asarray(self.weight >= HIGH_TRAFFIC)

    @property
    def roads(self) -> list[np.ndarray]:
        """The shape of each road, ``[k, 2]`` m."""
        return np.split(self.road_shape, np.cumsum(self.road_corners)[:-1])

    @property
    def mean_road_density(self) -> np.ndarray:
        """``[R]`` vehicles per km and lane, mean over ``mean_s``."""
        first, last = self.meta["mean_windows"]
        return np.asarray(self.road_density[first:last].mean(axis=0))

    def local_position(self, scale_to_m: float | None = None) -> np.ndarray:
        """``[n, 2]`` m from the south-west corner of what the devices span, where the UAV starts.

        Args:
            scale_to_m: the longer side is scaled to this many metres; by default distances are the real ones.
        """
        local = self.position - self.position.min(axis=0)
        return local if scale_to_m is None else local * (scale_to_m / local.max())

    def region_m(self, scale_to_m: float | None = None) -> tuple[float, float]:
        """Sides of what the devices span, m, at least 1."""
        width, height = np.maximum(self.local_position(scale_to_m).max(axis=0), 1.0)
        return float(width), float(height)

    def check_hops(self, speed_m_s: float, slot_cap_s: float, scale_to_m: float | None = None) -> None:
        """Refuse a place where a hop takes longer than a slot may.

        Raises:
            TrafficError: one line that names the hop.
        """
        stops = np.concatenate([np.zeros((1, 2)), self.local_position(scale_to_m)])
        metres = np.linalg.norm(stops[:, None] - stops[None], axis=-1)
        a, b = np.unravel_index(metres.argmax(), metres.shape)
        if metres[a, b] / speed_m_s > slot_cap_s:
            names = ["the start", *self.meta["names"]]
            raise TrafficError(
                f"{self.name}: the hop from {names[a]} to {names[b]}, {metres[a, b]:,.0f} m, takes "
                f"{metres[a, b] / speed_m_s:,.0f} s at {speed_m_s:g} m/s; a slot lasts at most {slot_cap_s:g} s "
                f"(slot_cap_s); place the devices closer or set place_scale_m"
            )

    def save(self, path: str | Path) -> None:
        """Write the file, atomic or not at all."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "meta"}
        write_checked(Path(path), SCHEMA, {"meta": self.meta}, arrays)


def load_evacuation(source: str | Path) -> Evacuation:
    """The evacuation of a place that ships with the package (``"albany"``, ``"round_lake"``), or of a file.

    Raises:
        TrafficError: there is none of that name; the file is not there, is damaged, was altered, is something else or of
            another version; one line.
    """
    path = Path(source)
    if str(source) in shipped_places():
        path = Path(str(PLACES / str(source) / "evacuation.npz"))
    elif not path.exists() and not path.suffix:
        raise TrafficError(f"{source}: neither a file nor a shipped place; {suggest(str(source), shipped_places())}")
    facts, arrays = read_checked(path, SCHEMA, "an evacuation", TrafficError)
    wanted = {field.name for field in fields(Evacuation)} - {"meta"}
    if set(arrays) != wanted or "meta" not in facts:
        raise TrafficError(f"{path}: is not an evacuation: it holds {', '.join(sorted(arrays))}")
    return Evacuation(meta=facts["meta"], **arrays)
