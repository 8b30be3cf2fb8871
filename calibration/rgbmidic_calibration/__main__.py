"""``python -m rgbmidic_calibration``: the same as the command `rgbmidic-calibrate`."""

from rgbmidic_calibration.cli import main

main()
