"""A crack that opens between two sides of known speckle, and the field at a tip, as photographs with exact truth."""

from functools import cache

import numpy as np
from textures import Texture

from rgbmidic import correlate
from rgbmidic.fields import Displacement, Units
from rgbmidic.tools.finite_elements import Williams
from rgbmidic.tools.finite_elements.crack_tip import williams_series

SHAPE = (240, 320)
REGION = (10, 10, 309, 229)
PATH = [(0, 120), (200, 120)]
SHIFT = np.array([0.3, -0.2])
NOISE = 2.0
GAP_LEVEL = 60.0


def opening_at(x, opening):
    """The jump along y (px): `opening` at x = 0, none from the tip on."""
    return opening * np.clip(1 - x / PATH[1][0], 0, None)


def truth(points, above, opening):
    """(u, v) of points (N, 2), of which some lie above the crack."""
    jump = opening_at(points[:, 0], opening) / 2
    return SHIFT + np.stack([np.zeros(len(points)), np.where(above, -jump, jump)], axis=1)


@cache
def reference_image(seed=0):
    return Texture.random(seed).image(SHAPE)


@cache
def deformed_image(opening, gap=GAP_LEVEL, jump=0.0, seed=0):
    """`gap` is the grey level between the sides, `jump` the fraction by which the lower one is lit more."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    x, y = x - SHIFT[0], y - SHIFT[1]
    texture, half, image = Texture.random(seed), opening_at(x, opening) / 2, np.full(SHAPE, gap)
    for side, light in ((-1, 1.0), (1, 1 + jump)):
        own = side * (y - PATH[0][1]) >= half
        image[own] = light * texture.at(x[own], (y - side * half)[own])
    return image


def noisy(image, seed):
    return image + np.random.default_rng(seed).normal(scale=NOISE, size=SHAPE)


TIP = (130.0, 130.0)
FIELD = (260, 260)
MATERIAL = Williams(youngs_modulus=70_000, poissons_ratio=0.33, plane="stress", units=Units(mm_per_pixel=0.05))
FACTORS = np.array([20.0, -6.0])
"""K_I and K_II, MPa sqrt(m): an opening of 1.5 px at the edge of the field."""
T_STRESS = 20.0


def williams_field(x, y, side):
    """(u, v) in px at points from the tip, y down, on the continued field of one side (1: above, on the left)."""
    shear = MATERIAL.youngs_modulus / (1 + MATERIAL.poissons_ratio)
    root = 1 / np.sqrt(2 * np.pi * MATERIAL.units.mm_per_pixel * 1e-3) / shear
    coefficients = np.r_[0.1, -0.07, FACTORS * root, T_STRESS / 4 / shear, 0, 2e-3 * FACTORS[0] * root, 1e-5]
    angle = np.arctan2(-y, x)
    angle += 2 * np.pi * side * (angle * side < -np.pi / 2)
    terms = williams_series(np.hypot(x, y).ravel(), angle.ravel(), range(4), MATERIAL.kolosov) @ coefficients
    return terms[:, 0].reshape(x.shape), -terms[:, 1].reshape(x.shape)


@cache
def cracked_images():
    texture = Texture.random(3, waves=120)
    y, x = (axis.astype(float) - at for axis, at in zip(np.mgrid[: FIELD[0], : FIELD[1]], TIP[::-1], strict=True))
    deformed = np.full(FIELD, GAP_LEVEL)
    for side in (1, -1):
        u, v = np.zeros((2, *FIELD))
        for _ in range(12):  # where each pixel comes from: the field's gradient is .01
            u, v = williams_field(x - u, y - v, side)
        own = side * (y - v) <= 0
        deformed[own] = texture.at((x - u)[own] + TIP[0], (y - v)[own] + TIP[1])
    return texture.image(FIELD), deformed


def cracked(noise, seed, element_size=16):
    random = np.random.default_rng(seed)
    pair = [image + random.normal(scale=noise, size=FIELD) for image in cracked_images()]
    options = {"region": (6, 6, 253, 253), "element_size": element_size, "cracks": [[(0, TIP[1]), TIP]]}
    return correlate(*pair, **options)


def as_nodal(solutions):
    u, v, u_std, v_std = np.moveaxis([np.c_[one.displacement, one.displacement_std] for one in solutions], -1, 0)
    return Displacement.in_plane(u, v, u_std, v_std)
