"""Frames in (`readers`, `frames`, `writers`) and results out (`store`)."""
