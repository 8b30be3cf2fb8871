"""rgbmidic: Digital Image Correlation that survives light reflections.

Several coloured lights shine at once, one colour camera records one raw frame per state, and one weighted
minimisation over the separated illumination images gives the displacement (Multiple Illumination DIC).

The names of the package are listed in ``__init__.pyi`` and imported on first use, so that ``import rgbmidic`` stays
cheap.
"""

import lazy_loader

from rgbmidic.tools import add_to_core as _add_tools_to_core

_add_tools_to_core()

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
