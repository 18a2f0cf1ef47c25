"""Runs: carry out a study, in one process or several, with a run plan, checkpoints and a status."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
