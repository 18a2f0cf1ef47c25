"""Types of pytree fields. ``vmap`` may put batch axes, ``*batch``, in front of the axes of any leaf."""

from jaxtyping import Array, Bool, Num

Scalar = bool | int | float | Num[Array, "*batch"] | Bool[Array, "*batch"]
"""A Python number or an array: ``[]`` for one scenario, ``[B]`` for a batch."""

Range = tuple[Scalar, Scalar]
"""``(low, high)``."""
