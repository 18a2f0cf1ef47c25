"""Studies of places: layouts with the devices' positions in a simulated evacuation and the traffic around them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from uavmec_jax.env.layout import Layout, Traffic
from uavmec_jax.errors import StudyError
from uavmec_jax.scenarios.places import traffic_weights
from uavmec_jax.studies.schema import Study, check_inside
from uavmec_jax.traffic.evacuation import Evacuation, load_evacuation


def places_of(study: Study) -> tuple[str, ...]:
    """Return the places of a study, by name or path; none if its positions are random."""
    return tuple(study.axes.get("place", [study.place] if study.place else []))


def load_evacuations(study: Study) -> dict[str, Evacuation]:
    """Load the evacuations of a study's places, by the names that the study gives them.

    Raises:
        TrafficError: a place or its file is not usable, or a hop would take longer than a slot may.
        StudyError: a place has another number of devices than the study, or a depot is outside.
    """
    evacuations = {}
    for name in places_of(study):
        evacuation = load_evacuation(name)
        if evacuation.n_devices != study.params.n_devices:
            raise StudyError(
                f"{study.name}: place {name!r} has {evacuation.n_devices} devices, params.n_devices is "
                f"{study.params.n_devices}; set params.n_devices = {evacuation.n_devices}"
            )
        lowest_speed = min(study.axes.get("uav_speed_m_s", [study.params.uav_speed_m_s]))
        shortest_cap = min(study.axes.get("slot_cap_s", [study.params.slot_cap_s]))
        evacuation.check_hops(lowest_speed, shortest_cap, study.place_scale_m)
        try:
            check_inside(study.depot, evacuation.region_m(study.place_scale_m), f"place {name!r}")
        except ValueError as error:
            raise StudyError(f"{study.name}: {error}") from None
        evacuations[name] = evacuation
    return evacuations


def move_to_places(layouts: Layout, agent_ids: Sequence[Mapping[str, Any]], study: Study) -> Layout:
    """Give the devices of agents' layouts, leaves ``[A, ...]``, the positions and the traffic of the agents' places.

    Args:
        layouts: returned unchanged if the study has no places.
        agent_ids: identities of the ``A`` agents.
        study: the study.

    Raises:
        TrafficError, StudyError: see :func:`load_evacuations`.
    """
    by_name = load_evacuations(study)
    if not by_name:
        return layouts
    evacuations = [by_name[agent_id.get("place", study.place)] for agent_id in agent_ids]
    weights = [traffic_weights(evacuation, study.traffic == "moving") for evacuation in evacuations]
    windows = max(map(len, weights))
    # The last window lasts to the end, so evacuations with fewer windows repeat theirs.
    padded = [np.pad(weight, ((0, windows - len(weight)), (0, 0)), mode="edge") for weight in weights]
    traffic = Traffic(
        weight=jnp.asarray(np.stack(padded)),
        window_s=jnp.asarray([evacuation.meta["window_s"] for evacuation in evacuations], jnp.float32),
        price=jnp.zeros(len(evacuations)),
    )
    position = np.stack([evacuation.local_position(study.place_scale_m) for evacuation in evacuations])
    return replace(layouts, position=jnp.asarray(position, jnp.float32), traffic=traffic)


def describe_places(study: Study) -> dict[str, dict[str, Any]]:
    """Describe the places of a study for its results: each one's network hash, and its devices' names and weights.

    Raises:
        TrafficError, StudyError: see :func:`load_evacuations`.
    """
    return {
        name: {
            "place": evacuation.name,
            "network_sha256": evacuation.meta["network_sha256"],
            "name": evacuation.meta["names"],
            "weight": [round(float(weight), 4) for weight in evacuation.weight],
            "high_traffic": evacuation.busy.tolist(),
        }
        for name, evacuation in load_evacuations(study).items()
    }
