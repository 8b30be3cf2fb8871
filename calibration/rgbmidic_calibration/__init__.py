"""Calibration of a colour camera and its lamps for rgbmidic: the command `rgbmidic-calibrate` and its library.

The laboratory procedure is in ``calibration/README.md``.
"""
