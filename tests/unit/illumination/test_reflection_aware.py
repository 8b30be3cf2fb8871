"""Texture model, colour factors, prediction filters and the reflection-aware demosaicer: laws and known cases."""

from dataclasses import replace

import colour_scenes as scenes
import numpy as np
import pytest
from naive_demosaic import site_channels
from scipy.ndimage import gaussian_filter, shift

from rgbmidic.errors import InputError
from rgbmidic.illumination.colour_factors import (
    CHANNEL,
    MosaicModel,
    channel_means,
    colour_factors,
    gather_moments,
    learn_texture,
)
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.demosaicing import (
    DISSIMILAR,
    OFFSET_VARIANCE,
    SPARKLE_VARIANCE,
    WIDE,
    FilterTables,
    filter_codes,
    malvar_demosaic,
    reconstruct,
)
from rgbmidic.illumination.images import Registration, frame_geometry
from rgbmidic.illumination.separation import demosaic, reconstructed_lights, separate
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.settings import BAYER_PATTERNS
from rgbmidic.tools.scene.camera import MEASURED_CROSSTALK

SHAPE = (160, 176)


@pytest.fixture(scope="module")
def albedo():
    return scenes.speckle(SHAPE)


@pytest.fixture(scope="module")
def mat(albedo):
    """Three lights of different strength without reflections."""
    return np.stack([1500 * albedo, 2000 * albedo, 1100 * albedo])


@pytest.fixture(scope="module")
def glaring(mat):
    """The same with a reflection over the whole of the green light."""
    return mat + np.stack([np.zeros(SHAPE), scenes.sparkle(SHAPE, 1200, 5), np.zeros(SHAPE)])


def learnt(lights, **options):
    mosaic = scenes.mosaic_of(lights, **options)
    model = MosaicModel.of(scenes.CROSSTALK, None, mosaic.values.shape)
    moments = gather_moments(mosaic.values, (0, 0), mosaic.noise, model)
    texture = learn_texture(moments, model)
    return texture, colour_factors(moments, texture, model)


def autocorrelation(image, distance):
    image = (image - image.mean()) / image.std()
    pairs = [(image[:, :-distance] * image[:, distance:]).mean(), (image[:-distance] * image[distance:]).mean()]
    return np.mean(pairs)


def test_texture_is_learnt_through_crosstalk_noise_and_mosaic(albedo, mat):
    texture, _ = learnt(mat)
    assert texture(0) == pytest.approx(1)
    for distance in (1, 2):
        assert texture(distance) == pytest.approx(autocorrelation(albedo, distance), abs=0.04)
    assert texture.specific < 0.1


def test_texture_is_the_same_with_and_without_reflection(mat, glaring):
    without, within = learnt(mat)[0], learnt(glaring)[0]
    distance = np.array([1.0, 1.5, 2.0, 3.0])
    np.testing.assert_allclose(within(distance), without(distance), atol=0.03)


@pytest.mark.parametrize("diameter", [1.0, 1.6])
def test_fine_speckle_is_learnt_and_filled_in_without_a_step(diameter):
    """What neighbouring colours agree less in is believed: no usual speckle is put in its place."""
    field = scenes.speckle(SHAPE, diameter=diameter)
    lights = np.stack([1500 * field, 2000 * field, 1100 * field])
    mosaic = scenes.mosaic_of(lights)
    texture = separate(mosaic, scenes.CROSSTALK).texture
    for distance in (1, 2):
        assert texture(distance) == pytest.approx(autocorrelation(field, distance), abs=0.05)
    assert texture.specific < 0.2
    ours, usual = (scenes.error(scenes.separated(mosaic, name), lights) for name in ("reflection-aware", "malvar"))
    assert (ours < 0.6 * usual).all()


def test_texture_checks_its_parameters():
    assert TextureModel.of_speckle(4.0).diameter == pytest.approx(4, rel=0.1)
    with pytest.raises(InputError, match="sum to 1"):
        TextureModel(weights=(0.5,), widths=(1.0,))
    with pytest.raises(InputError, match="equally many"):
        TextureModel(weights=(1.0,), widths=(1.0, 2.0))
    with pytest.raises(InputError, match="diameter"):
        TextureModel.of_speckle(0.0)


def test_band_energy_is_that_of_a_rendered_texture():
    """The closed form against the moments of a field with that autocorrelation."""

    rng, width = np.random.default_rng(2), 1.5
    field = gaussian_filter(rng.normal(size=(512, 512)), width / np.sqrt(2))
    field /= field.std()
    moments = gather_moments(field.astype(np.float32), (0, 0), None, MosaicModel.of(None, None, field.shape))
    band = TextureModel(weights=(1.0,), widths=(width,)).band
    # the local mean takes some of the coarse texture away
    assert moments.variance.mean() == pytest.approx(band.same, rel=0.15)
    ratios = moments.covariance.mean(axis=(1, 2)) / moments.variance.mean()
    np.testing.assert_allclose(ratios, np.array([band.adjacent, band.diagonal, band.adjacent]) / band.same, atol=0.004)


def test_slopes_follow_the_lights(mat):
    _, factors = learnt(mat)
    slopes = np.median(factors.slope, axis=(1, 2))
    expected = scenes.A @ np.array([1500, 2000, 1100])
    np.testing.assert_allclose(slopes / slopes[1], expected / expected[1], rtol=0.01)
    assert np.median(factors.specific) < 0.004


def test_a_reflection_is_private_to_its_channel(mat, glaring):
    _, factors = learnt(glaring)
    red, green, blue = np.median(factors.specific, axis=(1, 2))
    channels = np.tensordot(scenes.A, glaring - mat, axes=1)
    albedo_std = mat.std(axis=(1, 2))
    expected = channels.var(axis=(1, 2)) / (scenes.A @ albedo_std) ** 2
    assert green == pytest.approx(expected[1], rel=0.35)
    assert max(red, blue) < 0.1 * green


def test_camera_noise_is_not_taken_for_a_reflection(mat):
    dim = mat / 10
    _, factors = learnt(dim)
    assert np.median(factors.specific) < 0.01
    assert np.median(factors.noise) > 0.005


NOISE = np.full((3, 1, 1), 1e-4)
OWN_LIGHT = np.eye(3)[list(CHANNEL)]
"""Each channel sees a light of its own."""


def filters_at_rest(specific, texture):
    """Filters of one tile whose lights are not displaced."""
    still = np.zeros((3, 2, 1, 1))
    code = filter_codes(np.reshape(specific, (3, 1, 1)), NOISE, still, still)
    return FilterTables().find(code, texture, "RGGB", OWN_LIGHT)


def test_filters_sum_to_one_and_follow_the_trust():
    texture = TextureModel.of_speckle(4.0)
    _, alike, _ = filters_at_rest([1e-3, 1e-3, 1e-3], texture)
    _, apart, _ = filters_at_rest([1e-3, 1.0, 1e-3], texture)
    np.testing.assert_allclose(alike.sum(axis=3), 1, atol=0.02)
    site = site_channels((5, 5), "RGGB").ravel()
    # red at a blue pixel: what green tells counts for much less when green is in a reflection
    share = [abs(taps[0, 0, 0, site == 1, 0]).sum() for taps in (alike, apart)]
    assert share[1] < 0.3 * share[0]


def test_filters_of_nothing_in_common_use_the_own_colour_alone():
    texture = TextureModel(**{**vars_of(TextureModel.of_speckle(4.0)), "specific": 1.0})
    _, taps, size = filters_at_rest([2000.0, 2000.0, 2000.0], texture)
    assert size == WIDE
    site = site_channels((8, 8), "RGGB")[1:, 1:].ravel()  # a square of 7 around red begins at blue
    for channel in range(3):
        others = taps[0, 0, channel, site != channel, 0]
        assert abs(others).max() < 0.01


@pytest.mark.parametrize("by_lens", [np.zeros((3, 2)), np.array([[-0.4, 0.3], [0.1, 0], [0.7, -0.6]])])
@pytest.mark.parametrize("by_glints", [np.zeros((3, 2)), np.array([[0.06, -0.02], [-0.18, 0.1], [0.06, 0]])])
@pytest.mark.parametrize("left_out", [False, True])
def test_filters_are_the_best_prediction_of_what_crosstalk_shows_of_lights(by_lens, by_glints, left_out):
    """Against the covariances written out: green sparkles, the lights' textures are displaced, the greens differ."""
    texture, noise, size = TextureModel.of_speckle(4.0), 2.0**-6, 5
    seen = np.array([[0.75, 0.25, 0], [0.05, 0.97, 0], [0.03, 0.95, 0], [0, 0.5, 0.5]])
    sparkle, of_channels = np.array([2.0**-10, 0.5, 2.0**-10]), channel_means(seen)
    grid = [part[:, :, None, None] for part in (by_lens, by_glints)]
    code = filter_codes(sparkle.reshape(3, 1, 1), np.full((3, 1, 1), noise), *grid)
    _, taps, _ = FilterTables().find(code, texture, "RGGB", seen, left_out=left_out)
    offset, displacement = np.arange(size) - size // 2, by_lens + by_glints
    points = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)  # x, y

    def covariance(first, a, second, b):
        """Of what two rows of fractions of the lights see at two points."""
        own = np.exp(-((first - second) ** 2).sum() / (4 * SPARKLE_VARIANCE))
        common = OFFSET_VARIANCE * a.sum() * b.sum()
        for light, other in np.ndindex(3, 3):
            apart = displacement[light] - displacement[other]
            glints = ((by_glints[light] - by_glints[other]) ** 2).sum()
            alike = np.exp(-DISSIMILAR * glints) * float(texture(np.hypot(*(first - second - apart))))
            common += a[light] * b[other] * alike
        return common + a @ (sparkle * b) * own

    spread = np.sqrt(1 + of_channels**2 @ sparkle)
    kinds = np.array([[0, 1], [2, 3]])
    for p, q in np.ndindex(2, 2):
        site = np.roll(np.tile(kinds, (3, 3)), (-p, -q), axis=(0, 1))[:size, :size].ravel()
        matrix = [
            [covariance(x, seen[a], y, seen[b]) for y, b in zip(points, site, strict=True)]
            for x, a in zip(points, site, strict=True)
        ]
        white = np.full(size**2, noise)
        white[size**2 // 2] += 1e6 if left_out else 0
        for channel in range(3):
            wanted = [
                covariance(x, seen[a], np.zeros(2), of_channels[channel]) for x, a in zip(points, site, strict=True)
            ]
            expected = np.linalg.solve(np.array(matrix) + np.diag(white), wanted)
            # samples and channels count over their spread
            expected *= spread[np.array(CHANNEL)[site]] / spread[channel]
            np.testing.assert_allclose(taps[0, p, channel, :, q], expected, atol=2e-4)


def test_filters_that_are_kept_are_those_made_anew():
    texture, tables, random = TextureModel.of_speckle(4.0), FilterTables(), np.random.default_rng(0)
    for _ in range(3):
        specific, still = 2.0 ** random.integers(-10, 3, (3, 4, 5)), np.zeros((3, 2, 4, 5))
        codes = filter_codes(specific, np.full((3, 4, 5), 1e-3), still, still)
        kept, anew = (where.find(codes, texture, "GRBG", OWN_LIGHT) for where in (tables, FilterTables()))
        np.testing.assert_array_equal(kept[1][kept[0]], anew[1][anew[0]])


def registered(*by):
    """Lights whose images lie (x, y) px beside the first one's."""
    centre, radius = frame_geometry(SHAPE)
    parameters = np.zeros((3, 5))
    parameters[1:, :2] = by
    return Registration(lights=scenes.CROSSTALK.lights, parameters=parameters, centre=centre, radius=radius)


@pytest.mark.parametrize("by", [((0.5, 0.2), (1.0, -0.3)), ((1.7, -1.2), (2.8, -1.9))])
def test_lights_behind_a_lens_are_separated_where_it_puts_them(by, albedo):
    """Error of the lights over that of lights in register: lateral colour is known, so that little is lost."""
    lights = np.stack(
        [
            1500 * albedo,
            *(s * shift(albedo, (y, x), order=5, mode="mirror") for s, (x, y) in zip((2000, 1100), by, strict=True)),
        ]
    )
    mosaic = scenes.mosaic_of(lights)
    without = separate(mosaic, scenes.CROSSTALK)
    model = reconstruct(mosaic, scenes.CROSSTALK, registration=registered(*by))
    knowing = reconstructed_lights(model, scenes.CROSSTALK)
    usual = separate(mosaic, scenes.CROSSTALK, "malvar")
    ours = scenes.error(knowing, lights)
    assert (ours < 0.8 * scenes.error(without, lights)).all()
    assert (ours < 0.7 * scenes.error(usual, lights)).all()
    assert np.median(model.factors.light_specific) < 0.01
    assert np.abs(model.displacement.values).mean() < 0.02
    for distance in (1, 2):
        assert model.texture(distance) == pytest.approx(autocorrelation(albedo, distance), abs=0.05)  # .041


def test_greens_that_differ_cost_nothing_where_they_are_known(mat):
    """Red light is seen 40 % stronger by the greens of red rows than by those of blue rows."""
    difference = np.array([0.056, 0.02, -0.04])
    mosaic = scenes.mosaic_of(mat)
    values, change = mosaic.values.copy(), np.tensordot(difference / 2, mat, axes=1)
    values[0::2, 1::2] += change[0::2, 1::2]
    values[1::2, 0::2] -= change[1::2, 0::2]
    unequal = replace(mosaic, values=values.astype(np.float32))
    known = replace(scenes.CROSSTALK, green_difference=difference)
    equal = scenes.error(separate(mosaic, scenes.CROSSTALK), mat)[1]
    assert scenes.error(separate(unequal, known), mat)[1] < 1.01 * equal
    # 22.7 DN for 21.9
    assert scenes.error(separate(unequal, scenes.CROSSTALK), mat)[1] > 1.02 * equal


def test_lights_without_a_common_texture_are_taken_by_channel(mat):
    mosaic = scenes.mosaic_of(mat)
    texture = replace(reconstruct(mosaic, scenes.CROSSTALK).texture, common=False)
    model = reconstruct(mosaic, scenes.CROSSTALK, texture=texture)
    np.testing.assert_array_equal(model.predicted().values, malvar_demosaic(mosaic).values)


def vars_of(model):
    return {name: getattr(model, name) for name in ("weights", "widths", "offset", "specific", "correlation")}


@pytest.mark.parametrize("cfa", BAYER_PATTERNS)
def test_mat_lights_are_recovered_better_than_by_malvar(cfa, mat):
    mosaic = scenes.mosaic_of(mat, cfa=cfa)
    ours = scenes.error(separate(mosaic, scenes.CROSSTALK, "reflection-aware"), mat)
    usual = scenes.error(separate(mosaic, scenes.CROSSTALK, "malvar"), mat)
    assert (ours < 0.75 * usual).all()


def test_a_reflection_does_not_leak_into_the_other_lights(mat, glaring):
    mosaic = scenes.mosaic_of(glaring)
    ours = scenes.error(separate(mosaic, scenes.CROSSTALK, "reflection-aware"), glaring)
    usual = scenes.error(separate(mosaic, scenes.CROSSTALK, "malvar"), glaring)
    assert (ours[[0, 2]] < 0.6 * usual[[0, 2]]).all()
    assert ours[1] < 1.02 * usual[1]


@pytest.mark.parametrize(("light", "limit"), [(0, 0.96), (1, 0.97), (2, 0.92)])
def test_a_reflection_does_not_leak_through_the_crosstalk_of_a_measured_camera(light, limit, mat):
    """The worst light by our error over Malvar's: .95, .95 and .88; .97, 1.00 and 1.02 with channels taken apart."""
    lights, crosstalk = mat.copy(), Crosstalk(matrix=np.array(MEASURED_CROSSTALK), lights=scenes.CROSSTALK.lights)
    lights[light] += scenes.sparkle(SHAPE, 1200, 5)
    mosaic = scenes.mosaic_of(lights, matrix=crosstalk.matrix)
    ours, usual = (scenes.error(separate(mosaic, crosstalk, way), lights) for way in ("reflection-aware", "malvar"))
    assert (ours < limit * usual).all()


def test_reflection_index_tells_the_light_and_its_share(mat, glaring):
    clean = separate(scenes.mosaic_of(mat), scenes.CROSSTALK)
    assert np.median(clean.reflection_index(), axis=(1, 2)).max() < 0.05
    index = separate(scenes.mosaic_of(glaring), scenes.CROSSTALK).reflection_index()
    reflected = (glaring - mat).mean(axis=(1, 2)) / glaring.mean(axis=(1, 2))
    np.testing.assert_allclose(np.median(index, axis=(1, 2)), reflected, atol=0.05)
    assert index.shape == (3, *SHAPE)


def test_a_coloured_specimen_is_no_worse_than_colour_by_colour():
    lights = 1500 * np.stack([scenes.speckle(SHAPE, seed=seed) for seed in (1, 2, 3)])
    mosaic = scenes.mosaic_of(lights)
    texture = separate(mosaic, scenes.CROSSTALK).texture
    assert texture.specific == 1
    assert texture.correlation < 0.5
    ours, alone = (
        scenes.error(scenes.separated(mosaic, name), lights) for name in ("reflection-aware", "colour by colour")
    )
    assert (ours < 1.05 * alone).all()


def test_saturated_samples_are_unknown_and_their_neighbours_survive(mat):
    lights = mat.copy()
    lights[1, 60:63, 80:84] += 9000
    mosaic = scenes.mosaic_of(lights)
    channels = demosaic(mosaic, crosstalk=scenes.CROSSTALK)
    site = site_channels(SHAPE, "RGGB")
    hit = mosaic.saturated & (site == 1)
    assert hit.any()
    assert not channels.valid[1][hit].any()
    assert channels.valid[1].mean() > 0.99
    images = separate(mosaic, scenes.CROSSTALK)
    assert not np.isfinite(images.values[1][hit]).any()
    far = np.ones(SHAPE, bool)
    far[52:71, 72:92] = False
    clean = separate(scenes.mosaic_of(mat), scenes.CROSSTALK)
    assert np.abs(images.values[0] - clean.values[0])[far].max() < 60


def test_a_dead_frame_gives_numbers_or_unknown_but_no_failure():
    black = scenes.mosaic_of(np.zeros((3, 80, 80)))
    assert np.isfinite(separate(black, scenes.CROSSTALK).values).all()
    white = scenes.mosaic_of(np.full((3, 80, 80), 9000.0))
    assert not separate(white, scenes.CROSSTALK).valid.any()
    flat = scenes.mosaic_of(np.full((3, 80, 80), 900.0))
    assert scenes.error(separate(flat, scenes.CROSSTALK), np.full((3, 80, 80), 900.0)).max() < 20


def test_the_same_frame_gives_the_same_bits(glaring):
    mosaic = scenes.mosaic_of(glaring)
    first, second = (separate(mosaic, scenes.CROSSTALK).values for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_fewer_lights_than_channels(albedo):
    from rgbmidic.illumination.crosstalk import Crosstalk

    lights = np.stack([1500 * albedo, np.zeros(SHAPE), 1100 * albedo])
    two = Crosstalk(matrix=scenes.A[:, [0, 2]], lights=("red", "blue"))
    images = separate(scenes.mosaic_of(lights), two)
    assert images.names == ("red", "blue")
    assert (scenes.error(images, lights[[0, 2]]) < 60).all()


def test_small_frames_are_refused_with_the_way_out():
    with pytest.raises(InputError, match='use method "malvar"'):
        demosaic(scenes.mosaic_of(np.ones((3, 40, 80))))
