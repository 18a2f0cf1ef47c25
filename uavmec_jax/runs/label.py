"""The label of a run: everything that ``run.json`` says about it before it starts."""

import datetime
import sys
from dataclasses import asdict
from typing import Any

from uavmec_jax.runs.run_plan import RunPlan
from uavmec_jax.studies.places import describe_places
from uavmec_jax.studies.population import seeds_of
from uavmec_jax.studies.results import SCHEMA
from uavmec_jax.studies.schema import Study
from uavmec_jax.training import host


def label_of(study: Study, plan: RunPlan, command: str | None) -> dict[str, Any]:
    """Return the label: study, command, start time, partitions, versions and hardware."""
    return {
        "schema": SCHEMA,
        "study": study.name,
        "command": command or " ".join(sys.argv),
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "complete": False,
        "agents": plan.agents,
        "seeds": seeds_of(study),
        **({"places": places} if (places := describe_places(study)) else {}),
        "workers": plan.workers,
        "partitions": {name: asdict(partition) for name, partition in plan.partitions.items()},
        **host.describe(),
    }
