"""Runs: a study carried out, with a plan, checkpoints and a status, by one process or several."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
