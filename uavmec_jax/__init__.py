"""Which device should a rescue UAV serve next? A fast, exact JAX instrument for UAV-assisted edge computing.

``import uavmec_jax as um`` is immediate: jax is imported when a name is first used. ``__init__.pyi`` lists the names; the
rooms ``um.env``, ``um.planning``, ``um.agents``, ``um.training``, ``um.scenarios``, ``um.studies``, ``um.runs``,
``um.search``, ``um.traffic`` and ``um.interop`` have more.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
