"""Decisions without learning: heuristics, planners, certified upper bounds, forecasts, and the full observation."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
