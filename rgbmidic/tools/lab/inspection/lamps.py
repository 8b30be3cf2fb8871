"""Lamps of unequal strength: which to dim, and what that gains, by the uncertainty to expect then."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rgbmidic.illumination.checks import Check
from rgbmidic.illumination.contrast import LocalContrast
from rgbmidic.tools.lab.inspection.channels import Channel
from rgbmidic.tools.lab.inspection.prediction import Prediction
from rgbmidic.typing import BoolArray, FloatArray

MIN_STRENGTH_RATIO = 1.25
"""Strength of a light over that of the weakest one from which dimming its lamp is tried; chosen."""
MIN_RELATIVE_STRENGTH = 0.01
"""Least strength relative to the strongest light: a lamp that is off is another matter."""
MIN_GAIN = 1.1
"""Gain from which it is reported; chosen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LampBalance:
    """Strengths of the lights, and the exposure at which equal ones saturate no more than these.

    Attributes
    ----------
    strength : ndarray, shape (k,)
        Contrast of each light over that of the weakest one: what a reflection adds to the mean is no strength.
    exposure : float
        Exposure over that of the frame at which the brightest samples are as bright as in the frame, with all lights
        dimmed to the weakest one.
    """

    strength: FloatArray
    exposure: float

    @classmethod
    def of(
        cls, lights: LocalContrast, channels: Sequence[Channel], mixing: FloatArray, inside: BoolArray
    ) -> LampBalance:
        """Return the balance of a frame.

        Parameters
        ----------
        lights
            Local means and contrasts.
        channels
            Samples.
        mixing : ndarray, shape (C, k)
            Crosstalk matrix.
        inside : ndarray, shape (H, W)
            The region.

        Returns
        -------
        LampBalance
        """
        contrast = np.median((lights.level * lights.contrast)[:, inside], axis=1).astype(np.float64)
        strength = contrast / max(float(contrast.min()), MIN_RELATIVE_STRENGTH * float(contrast.max()), 1e-9)
        level = lights.level[:, inside].mean(axis=1, dtype=np.float64)
        brightest = np.array([np.nanquantile(channel.values[inside], 0.999) for channel in channels])
        dimmed = brightest * (mixing @ (level / np.maximum(strength, 1))) / np.maximum(mixing @ level, 1e-9)
        return cls(strength=strength, exposure=float(brightest.max() / max(dimmed.max(), 1e-9)))

    def advice(
        self,
        names: Sequence[str],
        present: Prediction,
        expected: Callable[[FloatArray], Prediction],
        *,
        noise_calibrated: bool,
    ) -> list[Check]:
        """Return which lamps to dim, or brighten, and what that gains, where it gains enough.

        Parameters
        ----------
        names
            Of the lights.
        present
            Uncertainty expected of the frame.
        expected
            Uncertainty with the lights so many times as strong.
        noise_calibrated
            Whether the camera noise is calibrated; photon noise is not known otherwise, which makes less of a gain.

        Returns
        -------
        list of Check
            One or none.
        """
        strong = [light for light in range(len(names)) if self.strength[light] > MIN_STRENGTH_RATIO]
        if not strong or self.strength.min() < 1:
            return []
        present_std, balanced_std = (
            float(np.nanmedian(prediction.std)) for prediction in (present, expected(self.exposure / self.strength))
        )
        if not present_std > MIN_GAIN * balanced_std:
            return []
        ratio = " : ".join(f"{value:.1f}" for value in self.strength)
        instructions = " and ".join(f"{names[light]} dimmed to {1 / self.strength[light]:.0%}" for light in strong)
        gain = f"{balanced_std:.4f} px instead of {present_std:.4f} px are to be expected"
        if not noise_calibrated:
            gain = f"down to {balanced_std:.4f} px instead of {present_std:.4f} px may be expected (noise estimated)"
        return [
            Check(
                "unequal lamps",
                f"the lights are as strong as {ratio} ({' : '.join(names)}): with {instructions} and "
                f"{self.exposure:.1f} times the exposure, or as much more light of the others, {gain}",
                present_std / balanced_std,
                MIN_GAIN,
            )
        ]
