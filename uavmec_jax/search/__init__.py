"""Hyperparameter search: Optuna proposes batches of trials; each batch is a population under successive halving."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
