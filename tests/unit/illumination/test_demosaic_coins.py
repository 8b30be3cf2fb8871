"""Real captures: a coin under three single lights, mixed into one colour frame and separated again."""

import colour_scenes as scenes
import numpy as np
import pytest

METHODS = ("reflection-aware", "malvar", "bilinear", "Menon2007", "colour by colour")
SIDE = 320


@pytest.fixture(scope="module")
def coin(real_data):
    """Three lights (3, 320, 320), brightest hundredth at 1000 DN.

    Each capture is itself a raw mosaic, so its full image is known only coarser: the mean over 4 x 4 raw pixels, two
    Bayer cells each way, the same mix of colours everywhere. Binning also takes the 8-bit steps (values of 5 to 15 DN)
    down to a few per cent of the contrast.
    """
    folder = real_data("multilight_raw_coin_italy")
    cv2 = pytest.importorskip("cv2")
    raw = [cv2.imread(str(folder / f"I_0{n}.png"), cv2.IMREAD_UNCHANGED) for n in (1, 2, 4)]
    binned = np.stack([one.reshape(687, 4, 916, 4).mean(axis=(1, 3)) for one in raw])
    part = binned[:, 183 : 183 + SIDE, 298 : 298 + SIDE]
    return part * (1000 / np.percentile(part, 99, axis=(1, 2)))[:, None, None]


def test_three_lights_are_recovered_from_one_frame_better_than_by_usual_methods(coin):
    mosaic = scenes.mosaic_of(coin, full_scale=1e5)
    error = {name: scenes.error(scenes.separated(mosaic, name), coin) for name in METHODS}
    together = {name: np.sqrt(np.mean(e**2)) for name, e in error.items()}
    ours = together.pop("reflection-aware")
    assert ours < 0.98 * min(together.values()), (ours, together)
    best = np.min([error[name] for name in together], axis=0)
    assert (error["reflection-aware"] < 1.05 * best).all()
