"""How much each light counts at each pixel (paper, section 3.2)."""
