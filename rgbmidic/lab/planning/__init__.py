"""Where lamps will reflect, what uncertainty to expect, and where the lamps would stand better."""
