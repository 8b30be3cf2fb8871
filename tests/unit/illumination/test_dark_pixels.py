"""The one rule for dark: a light's local mean is at most 1 % of the full scale."""

import numpy as np

from rgbmidic.illumination.images import IlluminationImages, without_dark_pixels


def test_a_light_is_excluded_where_it_is_dark_and_nowhere_else() -> None:
    values = np.full((2, 96, 160), 200.0, dtype=np.float32)
    values[1, :, 80:] = 5  # of 1000
    images = IlluminationImages(values=values, valid=values > 0, names=("red", "blue"), full_scale=1000.0)
    weights = np.ones(values.shape, dtype=np.float32)
    out = without_dark_pixels(images, weights)
    assert weights.all()
    assert out[0].all()
    assert out[1, :, :80].all()
    edge = 80 + int((out[1, 48, 80:] == 0).argmax())
    assert 18 < edge - 80 < 22  # 1.95 standard deviations of its window of 10 px, where the lit fraction is 2.6 %
    assert not out[1, :, edge:].any()
