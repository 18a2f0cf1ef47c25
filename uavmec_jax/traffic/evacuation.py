"""The result of a simulated evacuation: one small file, which training, evaluation and figures read without SUMO."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from uavmec_jax.errors import TrafficError
from uavmec_jax.files.archives import MAX_USER_BYTES, read_checked, write_checked
from uavmec_jax.traffic.evacuation_schema import check_evacuation
from uavmec_jax.traffic.place import file_of

SCHEMA = 1
"""Version of the file format."""

HIGH_TRAFFIC = 0.4
"""Weight from which a device counts as being in high traffic. No device of the shipped places has a weight near it."""


@dataclass(frozen=True)
class Evacuation:
    """A place, its devices, and how dense the traffic near each of them is.

    ``n`` devices, ``W`` windows, ``R`` roads with ``P`` corners in total.

    Attributes:
        meta: ``place``, ``description``, ``names`` of the devices, ``roads`` by id, ``window_s``, ``mean_s``,
            ``mean_windows``, ``radius_m``; and how it was made: ``vehicles``, ``seeds``, ``loaded``, ``unfinished``,
            ``teleports``, ``cut_off``, ``warnings``, ``sumo``, ``network_sha256``, ``command``, ``settings``.
        position: ``[n, 2]`` m in the network.
        density: ``[n]`` vehicles per km and lane near each device, mean over ``mean_s`` of the evacuation and over the seeds.
        density_spread: ``[n]`` standard deviation of the same over the seeds.
        weight: ``[n]`` in [0, 1], density relative to that of the busiest device.
        window_weight: ``[W, n]`` in [0, 1], density in each window relative to that of the busiest device and window.
        road_shape: ``[P, 2]`` m, the corners of all roads, one road after the other.
        road_corners: ``[R]`` number of corners of each road.
        road_lanes: ``[R]`` number of lanes.
        road_density: ``[W, R]`` vehicles per km and lane, mean over the seeds.
    """

    meta: dict[str, Any]
    position: Float[np.ndarray, "n 2"]
    density: Float[np.ndarray, " n"]
    density_spread: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    window_weight: Float[np.ndarray, "W n"]
    road_shape: Float[np.ndarray, "P 2"]
    road_corners: Int[np.ndarray, " R"]
    road_lanes: Int[np.ndarray, " R"]
    road_density: Float[np.ndarray, "W R"]

    @property
    def name(self) -> str:
        """Name of the place."""
        return str(self.meta["place"])

    @property
    def n_devices(self) -> int:
        """Number of devices."""
        return len(self.weight)

    @property
    def busy(self) -> Bool[np.ndarray, " n"]:
        """``[n]`` whether each device is in high traffic: its weight is at least :data:`HIGH_TRAFFIC`."""
        return np.asarray(self.weight >= HIGH_TRAFFIC)

    @property
    def roads(self) -> list[np.ndarray]:
        """Corners of each road, ``[k, 2]`` m."""
        return np.split(self.road_shape, np.cumsum(self.road_corners)[:-1])

    @property
    def mean_road_density(self) -> Float[np.ndarray, " R"]:
        """``[R]`` vehicles per km and lane, mean over ``mean_s``."""
        first, last = self.meta["mean_windows"]
        return np.asarray(self.road_density[first:last].mean(axis=0))

    def local_position(self, scale_to_m: float | None = None) -> Float[np.ndarray, "n 2"]:
        """Return positions in metres from the south-west corner of the devices' bounding box, where the UAV starts.

        Args:
            scale_to_m: length to which the box's longer side is scaled; by default distances are the real ones.

        Raises:
            TrafficError: the box has no side that could be scaled.
        """
        local = self.position - self.position.min(axis=0)
        if scale_to_m is None:
            return local
        if not local.max() > 0:
            raise TrafficError(f"{self.name}: all devices stand at one point; leave out place_scale_m")
        return local * (scale_to_m / local.max())

    def region_m(self, scale_to_m: float | None = None) -> tuple[float, float]:
        """Return the sides of the devices' bounding box in metres, each at least 1; see :meth:`local_position`."""
        width, height = np.maximum(self.local_position(scale_to_m).max(axis=0), 1.0)
        return float(width), float(height)

    def check_hops(self, speed_m_s: float, slot_cap_s: float, scale_to_m: float | None = None) -> None:
        """Check that no hop between two stops takes longer than a slot may last.

        Raises:
            TrafficError: one does; the line names it.
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
        """Write the file atomically.

        Raises:
            TrafficError: something is not what :func:`load_evacuation` would accept; nothing is written.
        """
        arrays = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "meta"}
        check_evacuation(path, self.meta, arrays)
        write_checked(Path(path), SCHEMA, {"meta": self.meta}, arrays)


def load_evacuation(source: str | Path) -> Evacuation:
    """Load the evacuation of a place that ships with the package (``"albany"``, ``"round_lake"``), or of a file.

    Raises:
        TrafficError: no shipped place has that name; the file does not exist, is damaged, was altered, is of another kind or
            version, or holds something that no evacuation has; one line.
    """
    path = file_of(source, "evacuation.npz")
    facts, arrays = read_checked(path, SCHEMA, "an evacuation", TrafficError, max_bytes=MAX_USER_BYTES)
    expected = {field.name for field in fields(Evacuation)} - {"meta"}
    if set(arrays) != expected or "meta" not in facts:
        raise TrafficError(f"{path}: is not an evacuation: it holds {', '.join(sorted(arrays))}")
    check_evacuation(path, facts["meta"], arrays)
    return Evacuation(meta=facts["meta"], **arrays)
