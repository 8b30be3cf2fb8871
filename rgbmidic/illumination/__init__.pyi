"""Names of the package; each is imported on first use."""

from .crosstalk import unmix
from .images import IlluminationImages
from .linear import linearise
from .separation import demosaic, separate

__all__ = ["IlluminationImages", "demosaic", "linearise", "separate", "unmix"]
