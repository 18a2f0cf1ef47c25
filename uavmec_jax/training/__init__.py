"""The population: many agents in lockstep, on the local devices, in a chunked host loop."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
