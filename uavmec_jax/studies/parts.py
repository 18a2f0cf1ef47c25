"""The parts of a study: agents of one algorithm and one fleet, whose arrays have one shape."""

import itertools
from dataclasses import dataclass
from typing import Any

from uavmec_jax.studies.schema import Study

PART_AXES = ("algorithm", "uavs", "depots")
"""Axes along which a study is split, the outermost first."""


@dataclass(frozen=True)
class Part:
    """One part of a study.

    Attributes:
        name: its name in the run plan: the algorithm, and the values of the other axes along which the study is split.
        study: the study of the part alone, without these axes.
        values: the part's values on these axes.
    """

    name: str
    study: Study
    values: dict[str, Any]


def split_study(study: Study) -> list[Part]:
    """Split a study into its parts, in the order in which they run; most studies have one."""
    split = [axis for axis in PART_AXES if axis in study.axes]
    axes = {name: values for name, values in study.axes.items() if name not in split}
    parts = []
    for values in itertools.product(*(study.axes[axis] for axis in split)):
        fixed = dict(zip(split, values, strict=True))
        alone = study.model_copy(update=fixed | {"axes": axes})
        fleet = [f"{axis}={value}" for axis, value in fixed.items() if axis != "algorithm"]
        parts.append(Part(name=", ".join([alone.algorithm, *fleet]), study=alone, values=fixed))
    return parts
