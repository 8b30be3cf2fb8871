"""The command `rgbmidic`: a file per group of commands, thin, no science."""
