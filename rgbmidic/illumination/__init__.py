"""From a raw frame to one image per light: linearise, demosaic, unmix; calibration and checks of a frame.

The names of the package are listed in ``__init__.pyi`` and imported on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
