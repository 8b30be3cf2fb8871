"""Raw frames and where they come from."""
