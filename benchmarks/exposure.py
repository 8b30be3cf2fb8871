"""Light budget of a fast test: what an exposure costs in motion blur and brings in electrons."""

from __future__ import annotations

import math
from collections.abc import Iterator

from .tables import Row, table

PLANCK, LIGHT_SPEED = 6.62607015e-34, 299792458.0
"""J s and m/s (SI)."""


def electrons(
    *, irradiance: float, exposure: float, f_number: float, magnification: float, pixel: float, efficiency: float,
    wavelength: float = 525e-9, reflectance: float = 0.8, transmission: float = 0.9,
) -> float:  # fmt: skip
    """Electrons that a pixel collects from mat white paint.

    A Lambertian surface under the irradiance E (W/m²) has the radiance ρE/π; a lens of f-number F and transmission τ
    gives the image the irradiance τ ρE / (4 F² (1 + m)²), of which a pixel of the side a converts η λ/(hc) to
    electrons.
    """
    image = transmission * reflectance * irradiance / (4 * f_number**2 * (1 + magnification) ** 2)  # W/m²
    return image * pixel**2 * exposure * efficiency * wavelength / (PLANCK * LIGHT_SPEED)


@table("exposure", page="tutorials/impact", cost=0.1)
def exposure(quick: bool) -> Iterator[Row]:
    """Exposure of a fast test: 0.1 mm/px, pixels of 20 µm with a quantum efficiency of .4, f/2.8, one lamp of 20 W of
    light over a disc of 100 mm. Blur of a surface at 10 m/s, and electrons of white paint under that lamp."""
    irradiance = 20 / (math.pi * 0.05**2)
    for rate in (10_000, 50_000, 100_000, 200_000, 500_000):
        for name, seconds in {"nine tenths of the interval": 0.9 / rate, "1 µs strobe": 1e-6}.items():
            yield {
                "frames/s": str(rate),
                "exposure": name,
                "exposure [µs]": seconds * 1e6,
                "blur at 10 m/s [px]": 10 * seconds / 1e-4,
                "electrons": electrons(irradiance=irradiance, exposure=seconds, f_number=2.8, magnification=0.2,
                                       pixel=20e-6, efficiency=0.4),
            }  # fmt: skip
