"""Types of pytree fields. Any leaf may have batch axes in front, ``*batch``, put there by ``vmap``."""

from jaxtyping import Array, Bool, Num

Scalar = bool | int | float | Num[Array, "*batch"] | Bool[Array, "*batch"]
"""A Python number, or an array: ``[]`` for one scenario, ``[B]`` for a batch."""

Range = tuple[Scalar, Scalar]
"""``(low, high)``."""
