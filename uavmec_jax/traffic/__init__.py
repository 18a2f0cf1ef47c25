"""Evacuation traffic: how much of it each device sees.

SUMO simulates the evacuation of a place once (`uavmec traffic build`) and leaves a small file, an :class:`Evacuation`.
Training, evaluation and figures read that file and never start SUMO. Files from outside are checked before SUMO reads them, a
user's SUMO configuration is never run, and everything SUMO writes goes into a temporary folder.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
