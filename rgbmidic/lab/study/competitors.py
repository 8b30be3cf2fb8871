"""The four methods that the paper compares, as settings of one solver, and rgbmidic's own default beside them.

Plain DIC with one light (section 2.2), the same with a local grey-level correction (GLC-DIC, section 2.2 and ref. 14),
all lights together without weights (Fig. 13), and all lights with binary weights (MIDIC, section 3). In these four grey
levels are taken as they are and the lights' shares are not balanced: what rgbmidic does beyond the paper is in the
fifth, the settings that a test has where TEST.toml says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rgbmidic.correlation import Deformed, Reference, Solution, solve
from rgbmidic.correlation.start import find_start
from rgbmidic.errors import InputError
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.separation import correlated
from rgbmidic.settings import ELEMENT_SIZE, IlluminationSettings, SolverSettings
from rgbmidic.typing import FloatArray, FloatImage
from rgbmidic.weights.threshold import threshold_weights

__all__ = ["METHODS", "Competitor", "Method"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """What a method uses of the images.

    Attributes
    ----------
    title
        Its name in words.
    all_lights
        All lights in one solve, or one alone.
    weighted
        Whether reflections are excluded by binary weights.
    brightness
        Grey-level correction of the solver: ``"none"`` or ``"local"``.
    default
        rgbmidic's own settings: local normalisation, prefilter, weights by statistics.
    demosaic
        How a Bayer mosaic is separated; Malvar's filters for the paper's methods, whose figures are about the solve.
    """

    title: str
    all_lights: bool = False
    weighted: bool = False
    brightness: Literal["none", "local"] = "none"
    default: bool = False
    demosaic: str = "malvar"

    def correlated(self, images: IlluminationImages) -> FloatImage:
        """What the solve correlates (k, H, W)."""
        return correlated(images, IlluminationSettings()) if self.default else images.values


METHODS: dict[str, Method] = {
    "dic": Method(title="DIC, one light"),
    "glc-dic": Method(title="GLC-DIC, one light", brightness="local"),
    "midic-unweighted": Method(title="MIDIC without weights", all_lights=True),
    "midic": Method(title="MIDIC", all_lights=True, weighted=True),
    "default": Method(title="rgbmidic, default", all_lights=True, default=True, demosaic="auto"),
}
"""The methods by the name they have in perturbation.csv."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Competitor:
    """One method, ready to measure any number of states against one reference.

    Attributes
    ----------
    method
        One of `METHODS`.
    lights
        Indices of the lights it uses.
    reference
        The reference state.
    threshold, blur
        Of the weights; threshold None: no weights.
    """

    method: str
    lights: tuple[int, ...]
    reference: Reference
    threshold: float | None
    blur: float

    @classmethod
    def prepare(
        cls,
        method: str,
        images: IlluminationImages,
        region: Region,
        *,
        light: int = 0,
        threshold: float | None = None,
        blur: float = 10.0,
        element_size: float = ELEMENT_SIZE,
        prefilter: str = "none",
    ) -> Competitor:
        """Prepare the reference.

        Parameters
        ----------
        method
            One of `METHODS`.
        images
            Illumination images of the reference state.
        region
            What is measured.
        light
            Index of the light that the methods with one light use.
        threshold, blur
            As in `rgbmidic.weights.threshold.threshold_weights`; for the method ``"midic"`` only.
        element_size
            px.
        prefilter
            As in `rgbmidic.correlation.correlate`; the paper has none. A Bayer mosaic needs ``"binomial"``. The method
            ``"default"`` has its own.

        Raises
        ------
        InputError
            Unknown method or light, or a threshold missing.
        """
        if method not in METHODS:
            raise InputError(f"unknown method {method!r}; allowed are {', '.join(METHODS)}")
        if not 0 <= light < len(images.values):
            raise InputError(f"light {light} is not one of the {len(images.values)} lights")
        weighted, default = METHODS[method].weighted, METHODS[method].default
        if weighted and threshold is None:
            raise InputError(f"method {method!r} needs a weighting threshold; see `set_up_threshold`")
        lights = tuple(range(len(images.values))) if METHODS[method].all_lights else (light,)
        chosen = _only(images, lights)
        limit = threshold if weighted else None
        reference = Reference.prepare(
            METHODS[method].correlated(chosen),
            region,
            _weights(chosen, limit, blur),
            mesh=Tri3Mesh.from_region(region, element_size),
            prefilter=SolverSettings().prefilter if default else prefilter,
        )
        return cls(method=method, lights=lights, reference=reference, threshold=limit, blur=blur)

    def measure(self, images: IlluminationImages, start: FloatArray | None = None) -> Solution:
        """Displacement of a state against the reference.

        Parameters
        ----------
        images
            Illumination images of the state, of the same lights.
        start : ndarray, shape (N, 2), optional
            Displacement (px) to start from; None looks for it.
        """
        chosen, method = _only(images, self.lights), METHODS[self.method]
        weights = _weights(chosen, self.threshold, self.blur)
        deformed = Deformed.prepare(method.correlated(chosen), weights, prefilter=self.reference.prefilter)
        if start is None:
            start = find_start(self.reference, deformed).displacement
        options = SolverSettings(brightness=method.brightness)
        return solve(self.reference, deformed, start, options, statistics=method.default)


def _weights(images: IlluminationImages, threshold: float | None, blur: float) -> FloatImage:
    if threshold is None:
        return images.valid.astype(np.float32)
    return threshold_weights(images, threshold=threshold, blur=blur)


def _only(images: IlluminationImages, lights: tuple[int, ...]) -> IlluminationImages:
    chosen = list(lights)
    return IlluminationImages(
        values=images.values[chosen],
        valid=images.valid[chosen],
        names=tuple(images.names[light] for light in chosen),
        full_scale=images.full_scale,
    )
