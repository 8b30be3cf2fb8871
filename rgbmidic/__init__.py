"""rgbmidic: Digital Image Correlation that survives light reflections.

Several coloured lights shine at once, one colour camera records one raw frame per state, and one weighted
minimisation over the separated illumination images gives the displacement (Multiple Illumination DIC).
"""

__version__ = "0.1.0"
