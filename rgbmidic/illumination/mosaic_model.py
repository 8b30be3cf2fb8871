"""How the photosites of a Bayer mosaic see the lights, and where each light shows the texture.

A site of kind s at y records ``sum_l A_sl L_l(y)``. Light l shows the texture a of the specimen where the lens puts it,
``L_l(y) = mean_l + alpha_l a(y - d_l(y)) + e_l(y)``: the displacement d_l is the calibrated lateral colour, and e_l the
light's own component, the erratic part of a reflection. The two kinds of green differ by what leaks into them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.texture import DISPLACEMENTS, TextureModel, registered_lines
from rgbmidic.typing import FloatArray

Number = TypeVar("Number", bound=np.floating)
BLOCK = 8
"""Side of the blocks (px) of the grid."""
CHANNEL = (0, 1, 1, 2)
"""Channel of each kind of site: red, green in red rows, green in blue rows, blue."""
FAINTEST = 0.02
"""Least contrast of a light, relative to the largest one: what a filter is made for."""
_COARSE = 4
"""Blocks over which the displacement changes so little that the energy of registered planes is interpolated."""


def channel_means(sites: npt.NDArray[Number]) -> npt.NDArray[Number]:
    """Return what the channels have (3, ...) from what the sites have (4, ...): green is the mean of its two."""
    return np.stack([sites[0], (sites[1] + sites[2]) / sites.dtype.type(2), sites[3]])


@dataclass(frozen=True, slots=True, kw_only=True)
class MosaicModel:
    """The response of the sites to the lights, and the displacement at which each light shows the texture.

    Attributes
    ----------
    sites : ndarray, shape (4, k)
        Response A of red, green in red rows, green in blue rows and blue to each light.
    displacement : ndarray, shape (k, 2, h, w)
        Place (x, y) at which a light shows the texture, from the mean place of all, px on the grid of `BLOCK` px.
    """

    sites: FloatArray
    displacement: FloatArray

    @classmethod
    def of(cls, crosstalk: Crosstalk | None, registration: Registration | None, shape: tuple[int, ...]) -> MosaicModel:
        """Return the model of frames of `shape` (rows, columns).

        Parameters
        ----------
        crosstalk
            None: each channel sees a light of its own.
        registration
            None: all lights show the texture at the same place.
        shape
            Rows and columns of the frame.

        Returns
        -------
        MosaicModel

        Raises
        ------
        InputError
            Crosstalk and registration are of different numbers of lights.
        """
        sites = np.eye(3)[list(CHANNEL)] if crosstalk is None else crosstalk.sites
        rows, columns = (-(-side // BLOCK) for side in shape)
        displacement = np.zeros((sites.shape[1], 2, rows, columns))
        if registration is not None:
            if len(registration.lights) != sites.shape[1]:
                raise InputError(
                    f"the registration is of {len(registration.lights)} lights, the crosstalk of {sites.shape[1]}"
                )
            y, x = np.mgrid[:rows, :columns].reshape(2, -1) * BLOCK + (BLOCK - 1) / 2
            positions = registration.displacement(np.stack([x, y], axis=1)).reshape(-1, rows, columns, 2)
            displacement = np.moveaxis(positions - positions.mean(axis=0), 3, 1)
        return cls(sites=sites, displacement=displacement)

    @property
    def matrix(self) -> FloatArray:
        """Response (3, k) of the channels."""
        return channel_means(self.sites)

    @property
    def in_register(self) -> bool:
        """Tell whether all lights show the texture at one place, and the greens are alike."""
        return not self.displacement.any() and np.array_equal(self.sites[1], self.sites[2])

    def light_fraction(self, contrast: FloatArray) -> FloatArray:
        """Return the fraction (4, k) of each light in the slope of each site's channel on the texture.

        Parameters
        ----------
        contrast : ndarray, shape (k,)
            Slopes alpha of the lights. They are rounded to an eighth of an octave, so that frames share filters.

        Returns
        -------
        ndarray, shape (4, k)
        """
        relative = np.maximum(contrast / max(contrast.max(), 1e-12), FAINTEST)
        rounded = np.exp2(np.round(8 * np.log2(relative)) / 8)
        return np.asarray(self.sites * rounded / (self.matrix @ rounded)[list(CHANNEL), None])

    def registered_energy(self, texture: TextureModel) -> FloatArray:
        """Second moments (k, k, h, w) of the lights' planes read at one place, over those of lights not displaced.

        A plane is a lattice of one sample in 2 x 2 px, and interpolation takes the finest of its texture.
        """
        fractions = np.linalg.pinv(self.sites) * self.sites.T  # of a light's plane, what each site contributes
        count, rows, columns = len(fractions), *self.displacement.shape[2:]
        size = -(-columns // _COARSE), -(-rows // _COARSE)
        coarse = [
            [cv2.resize(d, size, interpolation=cv2.INTER_AREA) for d in light_displacement]
            for light_displacement in self.displacement
        ]
        entry = np.round(np.mod(coarse, 2) / DISPLACEMENTS[1]).astype(np.intp)
        lines, weights = registered_lines(texture.widths), np.asarray(texture.weights)
        # whether two sites lie in different columns, and rows, of the cell
        kinds = [[(int(s % 2 != t % 2), int(s // 2 != t // 2)) for t in range(4)] for s in range(4)]
        energy = np.empty((count, count, rows, columns))
        for a, b in zip(*np.triu_indices(count), strict=True):
            fraction, registered, energy_at_rest = np.zeros((2, 2)), np.zeros(size[::-1]), 0.0
            np.add.at(fraction, tuple(np.moveaxis(np.array(kinds), 2, 0)), np.outer(fractions[a], fractions[b]))
            for (x, y), weight in np.ndenumerate(fraction):
                products = lines[x][:, entry[a, 0], entry[b, 0]] * lines[y][:, entry[a, 1], entry[b, 1]]
                registered += weight * (np.tensordot(weights, products, axes=1) + texture.offset)
                energy_at_rest += weight * float(weights @ (lines[x][:, 0, 0] * lines[y][:, 0, 0]) + texture.offset)
            energy[a, b] = energy[b, a] = cv2.resize(
                registered / energy_at_rest, (columns, rows), interpolation=cv2.INTER_LINEAR
            )
        return energy
