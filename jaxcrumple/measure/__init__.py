"""Measures of a deformed sheet, computed on the host: strain, creases, facets, energy, volume, stacking.

The public names stand in `__init__.pyi`. Each is imported when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
