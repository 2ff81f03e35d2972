"""jaxcrumple: a differentiable JAX simulator of thin elastoplastic sheets.

The public names stand in `__init__.pyi`. Each is imported when it is first used.
"""

import lazy_loader

from jaxcrumple.cli import entry

# Prepare the process before the first import that takes seconds.
entry.prepare()

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
