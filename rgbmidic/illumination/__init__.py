"""Raw mosaic to illumination images: linearise, demosaic, unmix, reflection index, weights."""
