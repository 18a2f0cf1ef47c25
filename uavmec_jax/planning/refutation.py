"""Refuting a lifetime: proof that no choice of hover sets meets its requirements.

The requirements are linear inequalities over the hover sets in all slots. The linear program that minimises the largest
violation over mixtures of hover sets, one mixture per slot, is solved by HiGHS (Huangfu and Hall 2018, through SciPy) over
a few of the sets, and those that its multipliers price best are added until none improves it: column generation (Gilmore
and Gomory 1961). The first columns are the answers to multiplicative weights (Plotkin, Shmoys and Tardos 1995), which are
nearly always enough.

The certificate is a vector of multipliers ``y >= 0``. If the cheapest hover set of every slot, priced by ``y``, together
costs more than ``y @ limits``, no choice meets the requirements (a Farkas certificate). This inequality is checked here, over
all hover sets, so that a refutation depends neither on the solver's tolerances nor on the sets that it has seen.
"""

import numpy as np
from jaxtyping import Float
from scipy.optimize import OptimizeResult, linprog
from scipy.sparse import csc_array, csr_array, hstack

from uavmec_jax.planning.hover_sets import Columns, HoverSets
from uavmec_jax.planning.requirements import Requirements

_ROUNDING = 1e-10
"""Relative tolerance for the double precision of the certificate's check."""

_WEIGHTINGS = 10
"""Rounds of multiplicative weights that choose the first columns."""

_LEAST_GAIN = 1e-9
"""A hover set whose reduced cost is not below minus this one does not improve the linear program."""

_SOLVED = 0
"""Status of SciPy's ``linprog`` for an optimal solution."""


class Refuter:
    """Refutes requirements on hover sets; what it has learned from one lifetime is of use for the next.

    Args:
        sets: the hover sets.
    """

    def __init__(self, sets: HoverSets) -> None:
        self._sets = sets
        self._columns: list[Columns] = []

    def refutes(self, requirements: Requirements) -> bool:
        """Return whether it is proved that no hover sets meet the requirements."""
        if not len(requirements.limits):
            return False
        columns = self._first_columns(requirements)
        coefficients = requirements.rows @ requirements.features.of(columns)
        while True:
            solution = _least_violation(requirements, columns, coefficients)
            if solution.status != _SOLVED or solution.fun <= 0.0:
                break
            multipliers = np.maximum(-solution.ineqlin.marginals, 0.0)
            costs, cheapest = self._price(requirements, multipliers)
            least = costs.sum() + np.minimum(multipliers @ requirements.levels, 0.0).sum()
            limit = multipliers @ requirements.limits
            if least > limit + _ROUNDING * multipliers @ np.abs(requirements.limits):
                return True
            improves = costs - solution.eqlin.marginals < -_LEAST_GAIN
            if not improves.any():
                break
            cheapest = Columns(*(leaf[improves] for leaf in cheapest))
            columns = _concatenate([columns, cheapest])
            coefficients = hstack([coefficients, requirements.rows @ requirements.features.of(cheapest)], format="csr")
        self._columns = [columns]
        return False

    def _first_columns(self, requirements: Requirements) -> Columns:
        """Return columns to start from: those of earlier lifetimes that fit, and the answers to multiplicative weights."""
        violation = np.zeros(len(requirements.limits))
        columns = self._columns
        for _ in range(_WEIGHTINGS):
            weights = np.exp(violation - violation.max())
            _, cheapest = self._price(requirements, weights / weights.sum())
            columns = [*columns, cheapest]
            latest = (requirements.rows @ requirements.features.of(cheapest)).sum(axis=1) - requirements.limits
            violation = violation + latest / max(np.abs(latest).max(), 1e-9)
        together = _concatenate(columns)
        fits = together.slot < len(requirements.largest)
        fits[fits] &= together.size[fits] <= requirements.largest[together.slot[fits]]
        distinct = np.unique(np.column_stack(together)[fits], axis=0, return_index=True)[1]
        return Columns(*(leaf[fits][distinct] for leaf in together))

    def _price(
        self, requirements: Requirements, multipliers: Float[np.ndarray, " R"]
    ) -> tuple[Float[np.ndarray, " T"], Columns]:
        """Return what the cheapest hover set of each slot costs in the weighted sum of the rows, and these sets."""
        prices = requirements.features.prices(multipliers @ requirements.rows)
        return self._sets.cheapest(prices, requirements.largest)


def _concatenate(columns: list[Columns]) -> Columns:
    return Columns(*(np.concatenate(leaves) for leaves in zip(*columns, strict=True)))


def _least_violation(requirements: Requirements, columns: Columns, coefficients: csr_array) -> OptimizeResult:
    """Solve the linear program over some columns; its last variable is the largest violation."""
    count, levels, slots = len(columns.slot), requirements.levels.shape[1], len(requirements.largest)
    violation = csr_array(np.full((len(requirements.limits), 1), -1.0))
    bounds = np.zeros((count + levels + 1, 2))
    bounds[:, 1] = np.inf
    bounds[count:-1, 1] = 1.0
    bounds[-1, 0] = -np.inf
    return linprog(  # type: ignore[call-overload]  # (the stubs do not know that matrices may be sparse)
        np.append(np.zeros(count + levels), 1.0),
        A_ub=hstack([coefficients, requirements.levels, violation], format="csc"),
        b_ub=requirements.limits,
        A_eq=csc_array((np.ones(count), (columns.slot, np.arange(count))), shape=(slots, count + levels + 1)),
        b_eq=np.ones(slots),
        bounds=bounds,
        method="highs-ds",
    )
