"""What follows from a result, with exact truth: jumps and stress intensity at cracks, strain over gauges, and the
comparison with a simulation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from crack_scene import (
    FACTORS,
    MATERIAL,
    NOISE,
    PATH,
    REGION,
    SHAPE,
    TIP,
    as_nodal,
    cracked,
    deformed_image,
    noisy,
    opening_at,
    reference_image,
)
from plate_fe import compared_plates
from textures import Texture

from rgbmidic import Region, Tri3Mesh, correlate, measure_sequence
from rgbmidic.fields import crack_jump, strain_of
from rgbmidic.tools.finite_elements import stress_intensity

from .tables import table

LIGHTS = (1.0, 0.7, 1.2)
"""Brightness of three lights on one paint."""


@table("crack_jump", page="how-to/results", cost=45, own_quick=True)
def jump(quick: bool) -> Iterator[dict[str, object]]:
    """Rendered cracks that open by 1, 2.5 and 5 px, gap dark or twice as bright as the paint, noise of 4 % of the
    contrast, three textures, all pairs but the tip's: rms(error / stated) of opening and sliding, pairs that are
    measured."""
    region = Region.from_rectangle(REGION, SHAPE)
    cases = [(size, lights, "auto") for size in (12, 16, 25) for lights in (1, 3)]
    cases += [(size, 1, "none") for size in (12, 25)]
    for size, lights, brightness in cases[4:5] if quick else cases:
        mesh, ratios, known = Tri3Mesh.from_region(region, size, [PATH]), [], []
        for texture in range(1 if quick else 3):
            for opening in (2.5,) if quick else (1.0, 2.5, 5.0):
                for gap in (60.0, 400.0):
                    states = reference_image(texture), deformed_image(opening, gap, 0.0, texture)
                    reference, deformed = (
                        np.stack([level * noisy(image, 10 * n + light) for light, level in enumerate(LIGHTS[:lights])])
                        for n, image in enumerate(states)
                    )
                    found = as_nodal(
                        [
                            *measure_sequence(
                                [deformed], reference=reference, region=region, mesh=mesh, brightness=brightness
                            )
                        ]
                    )
                    jump = crack_jump(mesh.nodes, mesh.elements, found, (10, PATH[0][1]), PATH[1])
                    error = jump.opening.values - opening_at(jump.points[:, 0], opening)
                    ratio = np.stack([error / jump.opening.std, jump.sliding.values / jump.sliding.std])[..., :-1]
                    known.append(np.isfinite(ratio).mean())
                    ratios.append(ratio.reshape(2, -1))
        opened, slid = np.sqrt(np.nanmean(np.concatenate(ratios, axis=1) ** 2, axis=1))
        yield {
            "elements [px]": str(size),
            "lights": str(lights),
            "brightness": brightness,
            "opening: error/stated": float(opened),
            "sliding: error/stated": float(slid),
            "measured [%]": 100 * float(np.mean(known)),
        }


@table("crack_tip", page="how-to/results", cost=6)
def tip(quick: bool) -> Iterator[dict[str, object]]:
    """Stress intensity of a rendered tip with K_I = 20 and K_II = -6 MPa√m (E = 70 GPa, .05 mm/px), noise of 4 % of
    the contrast, 16 draws, radii of 34 and 118 px: uncertainty stated (MPa√m), rms(error / stated), the same where the
    tip is fitted, chi-square over degrees of freedom."""
    for size in (20,) if quick else (10, 14, 20):
        solutions = [cracked(NOISE, seed, size) for seed in range(16)]
        mesh, nodal, radii = (solutions[0].nodes, solutions[0].elements), as_nodal(solutions), (34, 118)
        if size == 20:
            radii = (40, 118)
        found = stress_intensity(*mesh, nodal, TIP, radii, MATERIAL)
        fitted = stress_intensity(*mesh, nodal, TIP, radii, replace(MATERIAL, fit_tip=True))
        ratio, free = (
            np.sqrt(np.mean(((one.factors.values - FACTORS) / one.factors.std) ** 2, axis=0)) for one in (found, fitted)
        )
        std = found.factors.std.mean(axis=0)
        yield {
            "elements [px]": str(size),
            "K_I stated": float(std[0]),
            "K_II stated": float(std[1]),
            "K_I: error/stated": float(ratio[0]),
            "K_II: error/stated": float(ratio[1]),
            "tip fitted: K_I": float(free[0]),
            "tip fitted: K_II": float(free[1]),
            "chi-square": float(found.chi_square.mean()),
        }


WAVE, HEIGHT = 120.0, 0.1
"""Length and height (px) of a wave of the displacement u along x."""


@table("gauge", page="how-to/results", cost=1, seed=2)
def gauge(quick: bool) -> Iterator[dict[str, object]]:
    """Strain exx of a rendered wave of 120 px (elements of 25 px, noise of 4 % of the contrast, 4 pairs) over gauges of
    three lengths: height of the wave, the true height after the gauge, the error relative to that and over stated
    uncertainty."""
    texture, shape = Texture.random(2), (200, 360)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    material = x
    for _ in range(5):  # the strain is .005: each step gains two digits
        material = x - HEIGHT * np.sin(2 * np.pi * material / WAVE)
    pair = texture.image(shape), texture.at(material, y)
    region, random, found = (12, 12, 347, 187), np.random.default_rng(2), []
    for _ in range(1 if quick else 4):
        noisy_pair = (image + random.normal(scale=NOISE, size=shape) for image in pair)
        found.append(correlate(*noisy_pair, region=region, initial=(0.0, 0.0)))
    nodes, elements = found[0].nodes, found[0].elements
    true = HEIGHT * np.sin(2 * np.pi * nodes[:, 0] / WAVE)
    inner = (np.abs(nodes - (shape[1] / 2, shape[0] / 2)) < (130, 60)).all(axis=1)
    phase = np.cos(2 * np.pi * nodes[inner, 0] / WAVE)
    for length in (75, 100, 150):
        exact = strain_of(nodes, elements, true, 0 * true, 0 * true + 1, 0 * true + 1, gauge=length).components[
            inner, 0
        ]
        strains = [
            strain_of(nodes, elements, *one.displacement.T, *one.displacement_std.T, gauge=length) for one in found
        ]
        values = np.array([strain.components[inner, 0] for strain in strains])
        stated = np.array([strain.components_std[inner, 0] for strain in strains])
        height = 2 * np.pi * HEIGHT / WAVE * (phase @ phase)
        yield {
            "gauge [px]": str(length),
            "height [%]": 100 * float((values @ phase).mean() / height),
            "of the true wave [%]": 100 * float(exact @ phase / height),
            "error [1e-4]": 1e4 * float(np.sqrt(np.mean((values - exact) ** 2))),
            "error/stated": float(np.sqrt(np.mean(((values - exact) / stated) ** 2))),
        }


STIFF = 1.03
"""Modulus of a simulation over the true one."""


@table("comparison", page="how-to/compare", cost=2, seed=1)
def comparison(quick: bool) -> Iterator[dict[str, object]]:
    """A plate with a hole in tension: measured (elements of 30 px, 8 pairs, noise of 8 % of the contrast) minus
    simulated, rms over stated uncertainty and chi-square, at the simulation's nodes and levelled."""
    made = compared_plates(draws=8, moduli=(1.0, STIFF), texture=3)[1.0]
    for way, text in (("nodes", "at the nodes"), ("levelled", "levelled")):
        for name in ("displacement", "exx", "eyy", "exy"):
            chi = float(np.mean([one.agreement[way, name].chi_square for one in made]))
            yield {"simulation": text, "quantity": name, "rms/stated": chi**0.5, "chi-square": chi}


@table("comparison_scale", page="how-to/compare", cost=7, keys=1, seed=1)
def comparison_scale(quick: bool) -> Iterator[dict[str, object]]:
    """The same with a modulus 3 % too large, four textures: scale that fits best, mean of the pairs, its stated
    uncertainty for one pair, rms((found - 1.03) / stated), chi-square of the rest; rms over stated of the levelled
    displacement."""
    for texture in (3,) if quick else (3, 4, 5, 6):
        made = compared_plates(draws=8, moduli=(1.0, STIFF), texture=texture)
        fits = [one.fit for one in made[STIFF]]
        pulls = [(fit.scale - STIFF) / fit.scale_std for fit in fits]
        chi = np.mean([one.agreement["levelled", "displacement"].chi_square for one in made[1.0]])
        yield {
            "texture": str(texture),
            "scale": f"{np.mean([fit.scale for fit in fits]):.4f}",
            "stated": float(np.mean([fit.scale_std for fit in fits])),
            "error/stated": float(np.sqrt(np.mean(np.square(pulls)))),
            "chi-square of the rest": float(np.mean([fit.chi_square for fit in fits])),
            "displacement: error/stated": float(np.sqrt(chi)),
        }
