"""The results of an inspection, as plain values, and the warnings that follow from them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rgbmidic.illumination.checks import Check, reported
from rgbmidic.illumination.contrast import CONTRAST
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.illumination.texture import COLOURED, TextureModel
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.pipeline.frame_quality import SPECKLES, SUITABILITY
from rgbmidic.renamed import state_new_names
from rgbmidic.tools.lab.inspection.channels import CONSTANTS
from rgbmidic.tools.lab.inspection.prediction import Prediction
from rgbmidic.typing import BoolArray, FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """A quantity over the measured nodes: median and 95 % quantile, both in px; NaN where nothing is measured."""

    median: float
    q95: float

    @classmethod
    def of(cls, std: FloatArray) -> Spread:
        """Return the spread of standard uncertainties (N,).

        Parameters
        ----------
        std : ndarray, shape (N,)
            Standard uncertainties; NaN where not measured.

        Returns
        -------
        Spread
        """
        measured = std[np.isfinite(std)]
        if not measured.size:
            return cls(median=float("nan"), q95=float("nan"))
        return cls(median=float(np.median(measured)), q95=float(np.quantile(measured, 0.95)))


@dataclass(frozen=True, slots=True)
class ChannelSummary:
    """The samples of one camera channel in the region.

    Attributes
    ----------
    name : str
        R, G, B; M for a monochrome camera, M1, M2, ... for lights in succession.
    mean, low, high : float
        Mean, 5 % and 95 % quantile of the samples above black, in fractions of the full scale.
    saturated : float
        Fraction of the samples that are saturated.
    speckle_px : float
        Full width at half maximum of the autocorrelation, px
        (`rgbmidic.tools.lab.inspection.channels.speckle_texture`).
    noise_dn : float
        Standard deviation of the camera noise of a sample at the mean level, DN; estimated from the frame where the
        calibration does not know the noise.
    """

    name: str
    mean: float
    low: float
    high: float
    saturated: float
    speckle_px: float
    noise_dn: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LightSummary:
    """The separated image of one light in the region.

    Attributes
    ----------
    name : str
    mean : float
        Mean grey level in fractions of the full scale.
    contrast : float
        Median of the local standard deviation over the local mean.
    reflecting : float or None
        Fraction of the region where the reflection index exceeds `REFLECTING` of the images; None for a single light.
    valid : float
        Fraction of the region where the light is known.
    negative : float
        Fraction of the region where the light's local mean is negative, which no light can be.
    std_alone : Spread
        Predicted standard uncertainty with this light alone, px.
    """

    name: str
    mean: float
    contrast: float
    reflecting: float | None
    valid: float
    negative: float
    std_alone: Spread


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True)
class Inspection:
    """Results of the inspection of one frame before a test.

    Attributes
    ----------
    name : str
        The frame.
    kind : str
        ``"bayer"``, ``"rgb"`` or ``"monochrome"``.
    channels : tuple of ChannelSummary
    lights : tuple of LightSummary
    frame_shape : tuple of int
        Rows and columns of the frame. Of it the region and its surroundings were looked at, H rows and W columns.
    origin : tuple of int
        Column and row of the frame at which the images below begin.
    images : IlluminationImages
        The separated lights (k, H, W), DN.
    reflection_index : ndarray, shape (k, H, W), float32, or None
        Fraction of a light's image that is not diffuse, 0 to 1; relative to the light with the most contrast at each
        place. None for a single light.
    saturated, region : ndarray, shape (H, W), bool
    lacks_contrast : ndarray, shape (H, W), bool
        Where no light reaches half the usual contrast: all of them reflect, or there is no paint.
    background : ndarray, shape (H, W), bool
        Part of `lacks_contrast` that is dark too.
    texture : TextureModel or None
        The texture that the colours of a mosaic have in common; None for cameras without a mosaic.
    noise : NoiseModel
        Camera noise, calibrated or estimated from the frame.
    noise_known, crosstalk_known : bool
        Whether the calibration states them; for a monochrome camera crosstalk counts as known.
    contradictions : tuple of Check
        Contradictions of the frame to the calibration: doubtful, or accepted.
    element_size : float
        px.
    mesh : Tri3Mesh
        Of the region, in px of the frame.
    prediction : Prediction
        Standard uncertainty to expect at its nodes, px.
    greens : float
        Difference of the means of the two greens of a mosaic beyond the calibrated one, over their mean; 0 for other
        cameras.
    clipping : str
        Where samples pile up below the stated white level, which then counts as the white level; empty: nowhere.
    repetition : str
        How the texture repeats itself; empty: it does not.
    doubts : tuple of Check
        Lights that lie apart or show no common texture (`rgbmidic.pipeline.frame_quality.separation_doubts`), lamps of
        unequal strength.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> from rgbmidic import inspect_frame
    >>> from rgbmidic.frames import ChannelFrame
    >>> speckle = gaussian_filter(np.random.default_rng(0).normal(size=(1, 64, 64)), (0, 2, 2))
    >>> levels = np.round(2000 + 2000 * speckle)
    >>> frame = ChannelFrame(values=levels, black_level=np.zeros(1), white_level=4095.0)
    >>> inspection = inspect_frame(frame, element_size=20)
    >>> [finding.name for finding in inspection.findings]
    ['noise unknown', 'coarse speckle']
    >>> 5 < inspection.speckle_px < 7
    True
    """

    name: str
    kind: str
    channels: tuple[ChannelSummary, ...]
    lights: tuple[LightSummary, ...]
    frame_shape: tuple[int, int]
    origin: tuple[int, int]
    images: IlluminationImages
    reflection_index: FloatImage | None
    saturated: BoolArray
    region: BoolArray
    lacks_contrast: BoolArray
    background: BoolArray
    texture: TextureModel | None
    noise: NoiseModel
    noise_known: bool
    crosstalk_known: bool
    contradictions: tuple[Check, ...]
    element_size: float
    mesh: Tri3Mesh
    prediction: Prediction
    greens: float
    clipping: str
    repetition: str
    doubts: tuple[Check, ...]

    @property
    def unmeasured_fraction(self) -> float:
        """Fraction of the nodes that cannot be measured."""
        return float(np.isnan(self.prediction.std).mean())

    @property
    def findings(self) -> tuple[Check, ...]:
        """The warnings, the gravest first."""
        return tuple(
            reported([*_set_up_checks(self), *_exposure_checks(self), *_speckle_checks(self), *_region_checks(self)])
        )

    @property
    def speckle_px(self) -> float:
        """Speckle size: the median over the channels; px, NaN where there is no texture."""
        sizes = [channel.speckle_px for channel in self.channels if np.isfinite(channel.speckle_px)]
        return float(np.median(sizes)) if sizes else float("nan")


def _set_up_checks(inspection: Inspection) -> Iterator[Check]:
    for contradiction in inspection.contradictions:
        yield Check(f"not calibrated: {contradiction.name}", contradiction.text)
    differ = f"the two greens of the pattern differ by {inspection.greens:.0%} more than calibrated: check cfa"
    yield Check("pattern", differ, inspection.greens, CONSTANTS.max_green_difference)
    if not inspection.crosstalk_known:
        consequence = (
            "the camera's channels stand for the lights, and a reflection of one light shows in the others too"
        )
        yield Check("crosstalk unknown", f"no crosstalk calibration: {consequence}; rgbmidic-calibrate crosstalk")
    if not inspection.noise_known:
        consequence = (
            "noise and the uncertainty from it are estimated from the frame, up to a few times too high for speckle"
        )
        yield Check(
            "noise unknown",
            f"no noise calibration: {consequence} under 4 px and in reflections; rgbmidic-calibrate noise",
        )
    yield from inspection.doubts
    for light in inspection.lights:
        negative = f"light {light.name} is negative on {light.negative:.0%} of the region"
        text = f"{negative}: crosstalk, pattern or black level are not those of this frame"
        yield Check("negative light", text, light.negative, CONSTANTS.max_negative)


def _exposure_checks(inspection: Inspection) -> Iterator[Check]:
    if inspection.clipping:
        yield Check("white level", f"{inspection.clipping}, as the figures here assume")
    for channel in inspection.channels:
        bright = (
            f"channel {channel.name}: {channel.saturated:.1%} of the samples are saturated and will not be measured"
        )
        text = f"{bright}; less exposure, or another place of the lamp"
        yield Check("saturated", text, channel.saturated, SUITABILITY.clipped)
        dark = f"channel {channel.name} is dark: 95 % of its samples are below {channel.high:.1%} of the full scale"
        yield Check("dark", f"{dark}; more light or exposure", max(CONSTANTS.min_level - channel.high, 0.0))


def _speckle_checks(inspection: Inspection) -> Iterator[Check]:
    texture, size = inspection.texture, inspection.speckle_px
    min_agreement = (
        CONSTANTS.min_agreement if size > 2 * CONSTANTS.min_speckle else COLOURED
    )  # coarse speckle is not too fine
    if any(doubt.name == "lights apart" for doubt in inspection.doubts):
        pass  # a texture of displaced lights is not that of the specimen
    elif texture is not None and (texture.specific > 0.5 or texture.correlation < min_agreement):
        yield Check(
            "coloured",
            f"the colours do not show one texture (agreement {texture.correlation:.2f}; of what each shows alone, "
            f"{texture.specific:.0%} is as coarse as the speckle): a coloured specimen, or speckle far too fine; each "
            "colour has only its own lattice, so speckles need 6 px and more",
        )
    elif texture is not None:
        yield Check(
            "fine speckle",
            f"the speckle is too fine for the colour lattice: neighbouring colours agree to {texture.correlation:.2f}, "
            f"{CONSTANTS.min_agreement} is needed (speckles of about {CONSTANTS.min_speckle:.1f} px); displacements "
            "will be pulled towards whole pixels by 0.003 px and more: coarser speckle, a nearer camera or a softer "
            "lens",
            max(CONSTANTS.min_agreement - texture.correlation, 0.0),
        )
    if inspection.repetition:
        yield Check("repetition", inspection.repetition)
    if np.isnan(size):
        yield Check("no texture", "no speckle is seen: its autocorrelation has no width")
    elif inspection.element_size < SPECKLES * size:
        coarse = f"speckles of {size:.1f} px are coarse for elements of {inspection.element_size:g} px"
        better = f"element_size = {np.ceil(SPECKLES * size):.0f} or finer speckle"
        yield Check("coarse speckle", f"{coarse}: at least {SPECKLES:g} per side, so {better}")


def _region_checks(inspection: Inspection) -> Iterator[Check]:
    hidden_fraction, dark_fraction = (
        float(mask[inspection.region].mean()) for mask in (inspection.lacks_contrast, inspection.background)
    )
    subject, cause = "the light does not show", "it reflects or saturates there"
    if len(inspection.lights) > 1:
        subject, cause = "no light shows", "all lights reflect or saturate there"
    reasons = []
    if dark_fraction > CONTRAST.max_hidden_fraction:
        reasons.append(f"it holds dark background ({dark_fraction:.1%}), draw it inside the specimen")
    if hidden_fraction - dark_fraction > CONTRAST.max_hidden_fraction or not reasons:
        reasons.append(f"{cause}, or there is no paint")
    text = f"{subject} the texture on {hidden_fraction:.1%} of the region: {'; '.join(reasons)}"
    yield Check("hidden", text, hidden_fraction, CONTRAST.max_hidden_fraction)
    lost_text = f"{inspection.unmeasured_fraction:.1%} of the nodes will not be measured"
    yield Check("not measured", lost_text, inspection.unmeasured_fraction)
