"""Evacuation traffic: which devices matter.

SUMO simulates a town's evacuation once (`uavmec traffic build`) and leaves a small file, an :class:`Evacuation`; training,
evaluation and figures read that and never start SUMO. Files from outside are checked before anything of SUMO sees
them, a user's SUMO configuration is never run, and all that SUMO writes goes into a folder that does not outlive us.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
