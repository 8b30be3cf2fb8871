"""The viewer in the browser: pages of Bokeh models (extra ``view``), served to this machine only."""

from rgbmidic.tools.view.server import serve

__all__ = ["serve"]
