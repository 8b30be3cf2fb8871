"""Displacement of the lights' textures against each other, from one mosaic.

Where paint reflects, glints sit on the flanks of raised droplets: the light that is reflected shows the common texture
displaced by some tenths of a pixel, and the displacement slides as the surface turns. Its variance hardly shows that.
The difference of each light's low-passed plane from the mean of the others, all read where the registration says that
they show the texture, is regressed on the gradient of that mean. What is smooth over the whole field is not glints but
lateral colour beyond the registration (`LightDisplacement.lateral`).

Which of several lights shows the texture where it is, is a question of agreement (`consensus_weights`): a light counts
by its precision and by the precision of the others that show it at the same place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic._kernels.texture import CELLS, displacement_scores
from rgbmidic.illumination.colour_factors import BLOCK, FAINTEST, ColourFactors, Moments, MosaicModel, upsample_rows
from rgbmidic.illumination.images import frame_geometry, registration_basis
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.mesh.pixel_map import window_means
from rgbmidic.typing import BoolArray, FloatArray

SIZE, REACH = 5, 8
"""Side of the square of samples of a prediction, px; rows and columns over which predictions are correlated."""
LEAST_STD = 1e-6
"""Least standard uncertainty of a displacement, px: far below what filters round it to."""
WINDOW = 20.0
"""Standard deviation (px) of the window in which a displacement is taken: glints change their place over some 50 px."""
BIAS_CORRELATION_RANGE = 34.0
"""Range r (px) of the correlation ``exp(-d^2 / (4 r^2))`` of what the lights' bias leaves at two places a distance d
apart: glints change their place over some 50 px, and the bias is seen in a window of 24 px. 32 to 36 px fit errors on
raised droplets of two renderers under three lights, 47 to 53 px under two lamps in succession (measured)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LightDisplacement:
    """Displacement of the lights' textures from their mean.

    Attributes
    ----------
    values : ndarray, shape (k, 2, h, w)
        In x and y (px), on a grid of blocks of 8 px.
    std : ndarray, shape (k, h, w)
        Standard uncertainty in each direction, px.
    """

    values: FloatArray
    std: FloatArray

    @property
    def significant(self) -> FloatArray:
        """The displacement shrunk by what chance explains of it, (k, 2, h, w).

        Empirical Bayes (Efron and Morris 1973): how far glints displace the lights is known from the whole frame.
        """
        chance, square = (self.std**2).mean(axis=0), (self.values**2).mean(axis=(0, 1))
        glints = max(float(np.average(square - chance, weights=chance**-2)), 0.0)
        return np.asarray(self.values * (glints / (glints + chance)))

    @property
    def without_glints(self) -> LightDisplacement:
        """The part alone that lateral colour explains: lights whose textures differ show nothing else."""
        lateral = self.lateral(np.ones(self.std.shape[1:], dtype=bool))
        values = np.moveaxis(lateral - lateral.mean(axis=0), 2, 1).reshape(self.values.shape)
        return LightDisplacement(values=values, std=self.std)

    def lateral(self, inside: BoolArray) -> FloatArray:
        """Displacement from the first light that varies over the field as lateral colour does (`registration_basis`).

        Parameters
        ----------
        inside : ndarray, shape (h, w)
            The blocks that count.

        Returns
        -------
        ndarray, shape (k, M, 2)
            In px at the M blocks inside; 0 for a light where chance explains a third of it.
        """
        rows, columns = np.nonzero(inside)
        blocks = np.stack([columns, rows], axis=1)
        basis = registration_basis(blocks, *frame_geometry((inside.shape[0], inside.shape[1])))
        fields = np.zeros((len(self.std), len(blocks), 2))
        chance = np.zeros(len(self.std))
        for light, std in enumerate(self.std[:, inside]):
            target, weight = self.values[light][:, inside].T, 1 / std[:, None]
            system = (basis * weight[..., None]).reshape(-1, basis.shape[2])
            covariance = np.linalg.pinv(system.T @ system)
            fields[light] = basis @ (covariance @ (system.T @ (target * weight).ravel()))
            scatter = max(float((((target - fields[light]) * weight) ** 2).mean()), 1.0)
            # a displacement has an error in common with those in the window of its estimate
            common = 4 * np.pi * (WINDOW / BLOCK) ** 2
            chance[light] = common * scatter * np.einsum("mdp,pq,mdq->m", basis, covariance, basis).mean()
        fields -= fields[0].copy()
        square = (fields**2).sum(axis=2).mean(axis=1)
        fields[square <= 9 * (chance + chance[0])] = 0
        return fields


def consensus_weights(
    displacement: FloatArray,
    variance: FloatArray,
    precision: FloatArray,
    *,
    harmless: float = 0.03,
    consistency_floor: float = 0.1,
) -> tuple[FloatArray, FloatArray]:
    """Weigh the lights by their precision and their agreement, and return how consistent those with weight are.

    Parameters
    ----------
    displacement : ndarray, shape (k, 2, h, w)
        Where each light shows the texture, px.
    variance : ndarray, shape (k, h, w)
        Of chance in each direction, px².
    precision : ndarray, shape (k, h, w)
        Of each light's displacement; in any unit.
    harmless
        Distance (px) of two lights at which each counts half for the other. Half and twice of it change the error of
        raised droplets by 2 % at most (benchmarks/reflections.py).
    consistency_floor
        What a light with which no other agrees counts: the square of it is its weight against lights that agree.

    Returns
    -------
    tuple of ndarray, shape (k, h, w) and (h, w)
        Weights of the lights, their sum 1; the weighted mean, 0 to 1, of how far each agrees with its nearest.
    """
    precision_fraction = precision / np.maximum(precision.sum(axis=0), 1e-30)
    consistency, nearest = np.zeros_like(precision_fraction), np.zeros_like(precision_fraction)
    lights = range(len(precision_fraction))
    for light in lights:
        for other_light in lights:
            if other_light != light:
                square_distance = ((displacement[light] - displacement[other_light]) ** 2).sum(axis=0)
                excess = np.maximum(square_distance - 2 * (variance[light] + variance[other_light]), 0)
                near = 1 / (1 + excess / harmless**2)
                consistency[light] += precision_fraction[other_light] * near
                nearest[light] = np.maximum(nearest[light], near)
        consistency[light] /= np.maximum(1 - precision_fraction[light], 1e-6)
    weights = precision_fraction * (consistency_floor + consistency) ** 2
    weights /= np.maximum(weights.sum(axis=0), 1e-30)
    return weights, np.minimum((weights * nearest).sum(axis=0), 1)


def light_displacement(
    moments: Moments, factors: ColourFactors, texture: TextureModel, model: MosaicModel, *, window: float = WINDOW
) -> LightDisplacement:
    """Displacement of the lights' textures against each other, beyond their registration.

    Parameters
    ----------
    moments, factors, texture, model
        Of the mosaic.
    window
        Standard deviation (px) of the window in which a displacement is taken.

    Returns
    -------
    LightDisplacement
    """
    count, width = len(moments.lights), moments.lights.shape[2]
    # the binomial weights of a plane sum to 256
    slope = 256 * np.maximum(factors.light_slope, FAINTEST * factors.light_slope.max())
    scale = upsample_rows(slope, CELLS, width)
    sums = np.empty((count, 3, *slope.shape[1:]), dtype=np.float32)
    displacement_scores(moments.lights, scale, CELLS, sums)
    blocks = window / BLOCK
    means = window_means(sums, blocks).astype(np.float64)
    information = means[:, 2:] + 1e-12
    estimate = means[:, :2] / information
    # by the scatter of the blocks' scores, which are nearly independent
    scatter = ((sums[:, :2] - estimate * sums[:, 2:]) ** 2).mean(axis=1).astype(np.float32)
    chance = window_means(scatter, blocks / np.sqrt(2)) / (4 * np.pi * blocks**2)
    # cells of 2 px; a light against the mean of all, not of the others
    unit = 2 / texture.gradient_gain * (count - 1) / count
    std = unit * np.sqrt(np.maximum(chance, 1e-12)) / information[:, 0]
    estimate = unit * estimate - _at_rest(moments.red, factors, texture, model)[:, :, None, None]
    # a single light lies at the mean of all, exactly
    return LightDisplacement(values=estimate - estimate.mean(axis=0), std=np.maximum(std, LEAST_STD))


def _at_rest(red: tuple[int, int], factors: ColourFactors, texture: TextureModel, model: MosaicModel) -> FloatArray:
    """Displacement (k, 2) that lights at one place show, px: that of the planes of the sites that see them."""
    slope = np.median(factors.light_slope, axis=(1, 2))
    slope = np.maximum(slope, FAINTEST * slope.max())
    fraction = np.linalg.pinv(model.sites) * (model.sites @ slope) / slope[:, None]
    row, column = red
    # column and row in the cell of red, of green in red and in blue rows, and of blue
    odd = np.array([[column, row], [1 - column, row], [column, 1 - row], [1 - column, 1 - row]])
    return np.asarray(texture.plane_displacement * (fraction @ (1 - 2 * odd)))
