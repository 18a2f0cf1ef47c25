"""Hyperparameter search: Optuna proposes trials in batches, each batch is one population with successive halving."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
