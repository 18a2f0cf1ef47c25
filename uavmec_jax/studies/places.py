"""Studies of places: agents' layouts get the positions of a simulated evacuation and the traffic that its devices see."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from uavmec_jax.env.layout import Layout, Traffic
from uavmec_jax.errors import StudyError
from uavmec_jax.scenarios.places import traffic_weights
from uavmec_jax.studies.schema import Study
from uavmec_jax.traffic.evacuation import Evacuation, load_evacuation


def places_of(study: Study) -> tuple[str, ...]:
    """The places of a study, by name or path; none if its towns are random."""
    return tuple(study.axes.get("place", [study.place] if study.place else []))


def load_evacuations(study: Study) -> dict[str, Evacuation]:
    """The evacuations of a study's places, by the names that the study gives them.

    Raises:
        TrafficError: a place or its file is not usable, or a hop would take longer than a slot may.
        StudyError: a place has another number of devices than the study.
    """
    found = {}
    for name in places_of(study):
        evacuation = load_evacuation(name)
        if evacuation.n_devices != study.params.n_devices:
            raise StudyError(
                f"{study.name}: place {name!r} has {evacuation.n_devices} devices, params.n_devices is "
                f"{study.params.n_devices}; set params.n_devices = {evacuation.n_devices}"
            )
        slowest = min(study.axes.get("uav_speed_m_s", [study.params.uav_speed_m_s]))
        shortest = min(study.axes.get("slot_cap_s", [study.params.slot_cap_s]))
        evacuation.check_hops(slowest, shortest, study.place_scale_m)
        found[name] = evacuation
    return found


def onto_places(layouts: Layout, agents: Sequence[Mapping[str, Any]], study: Study) -> Layout:
    """Layouts ``[A, ...]`` of agents with their devices in the places of the study; unchanged if it has none.

    Raises:
        TrafficError, StudyError: see :func:`load_evacuations`.
    """
    evacuations = load_evacuations(study)
    if not evacuations:
        return layouts
    own = [evacuations[agent.get("place", study.place)] for agent in agents]
    weights = [traffic_weights(evacuation, study.traffic == "moving") for evacuation in own]
    windows = max(map(len, weights))  # the last window lasts
    padded = [np.pad(weight, ((0, windows - len(weight)), (0, 0)), mode="edge") for weight in weights]
    traffic = Traffic(
        weight=jnp.asarray(np.stack(padded)),
        window_s=jnp.asarray([evacuation.meta["window_s"] for evacuation in own], jnp.float32),
        price=jnp.zeros(len(own)),
    )
    position = np.stack([evacuation.local_position(study.place_scale_m) for evacuation in own])
    return replace(layouts, position=jnp.asarray(position, jnp.float32), traffic=traffic)


def describe_places(study: Study) -> dict[str, dict[str, Any]]:
    """What the results of a study should know of its places: of each its devices' names, weights, and the network's hash.

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
