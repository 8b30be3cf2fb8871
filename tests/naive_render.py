"""Slow, obvious twin of the tracing kernels: one sub-pixel sample at a time, plain Python numbers."""

import math
from types import SimpleNamespace

import numpy as np

MASK = 0xFFFFFFFF
A, B, C = 0.80473785, -0.31061722, 0.50587936
LATTICE = np.array([[A, B, C], [C, A, B], [B, C, A]])
PLATE, CYLINDER, SPHERE = 0, 1, 2


def mix(h):
    h = ((h ^ (h >> 16)) * 0x7FEB352D) & MASK
    h = ((h ^ (h >> 15)) * 0x846CA68B) & MASK
    return h ^ (h >> 16)


def lattice_hash(i, j, k, seed):
    return mix(((i * 0x8DA6B343 + j * 0xD8163841 + k * 0xCB1AB31F) & MASK) ^ seed)


def gradient_noise(point, seed):
    """Value and gradient by summing over the eight corners; the gradient by the product rule, written out."""
    q = LATTICE @ point
    cell = np.floor(q).astype(int)
    t = q - cell
    fade, slope = t**3 * (t * (6 * t - 15) + 10), 30 * t**2 * (t - 1) ** 2
    value, gradient = 0.0, np.zeros(3)
    for corner in np.ndindex(2, 2, 2):
        c = np.array(corner)
        h = lattice_hash(*(int(x) for x in cell + c), seed)
        g = np.array([h & 1023, (h >> 10) & 1023, (h >> 20) & 1023]) * 2 / 1023 - 1
        w, dw = np.where(c, fade, 1 - fade), np.where(c, slope, -slope)
        dot = g @ (t - c)
        value += w.prod() * dot
        gradient += w.prod() * g + dot * np.array([dw[0] * w[1] * w[2], w[0] * dw[1] * w[2], w[0] * w[1] * dw[2]])
    return value, LATTICE.T @ gradient


def to_surface(p, body):
    kind, radius = body[0], body[1]
    if kind == PLATE:
        return p[2], np.array([p[0], p[1], 0.0])
    round_axes = np.array([1.0, 1.0 if kind == SPHERE else 0.0, 1.0])
    length = math.sqrt(((p * round_axes) ** 2).sum())
    return length - radius, np.where(round_axes > 0, p * radius / length, p)


def normal_at(p, body):
    if body[0] == PLATE:
        return np.array([0.0, 0.0, -1.0])
    return p / body[1] * [1, 1 if body[0] == SPHERE else 0, 1]


def droplets_near(p, body, paint, counts, seed):
    """Every droplet of the cells within reach."""
    cell, shell, reach, median, spread = paint[:5]
    low, high = np.floor((p - reach) / cell).astype(int), np.floor((p + reach) / cell).astype(int)
    for i, j, k in np.ndindex(*(high - low + 1)):
        i, j, k = int(i + low[0]), int(j + low[1]), int(k + low[2])
        h = lattice_hash(i, j, k, seed)
        for _ in range(int((h / 2**32 >= counts).sum())):
            place = {}
            for axis in "zxy":
                h = mix((h + 0x9E3779B9) & MASK)
                place[axis] = h / 2**32
            h = mix((h + 0x9E3779B9) & MASK)
            height, centre = to_surface(np.array([i + place["x"], j + place["y"], k + place["z"]]) * cell, body)
            if abs(height) <= shell:
                size = (h & 65535) / 65536 + (h >> 16) / 65536 - 1
                yield centre, median * math.exp(spread * math.sqrt(6) * size)


def paint_at(p, body, paint, counts, seed):
    """Cover, height and slope vector."""
    soft, dome = paint[5], paint[6]
    n = normal_at(p, body)
    inside, height, slope = 0.0, 0.0, np.zeros(3)
    for centre, radius in droplets_near(p, body, paint, counts, seed):
        d = p - centre
        inside = max(inside, (radius - np.linalg.norm(d)) / soft + 0.5)
        rest = 1 - d @ d / radius**2
        if rest > 0 and dome * rest**2 > height:
            height = dome * rest**2
            slope = -4 * dome * rest / radius**2 * (d - (d @ n) * n)
    t = min(inside, 1.0)
    cover = t * t * (3 - 2 * t)
    lattice = paint[9] if cover < 0.5 else paint[14]
    scale = (1 - cover) * paint[8] + cover * paint[13]
    value, gradient = gradient_noise(p / lattice, seed ^ 0x5BD1E995)
    return cover, height + scale * lattice * value, slope + scale * (gradient - (gradient @ n) * n)


def hit(origin, direction, body):
    if body[0] == PLATE:
        t = -origin[2] / direction[2]
        return origin + t * direction if t > 0 else None
    axes = [0, 1, 2] if body[0] == SPHERE else [0, 2]
    o, d = origin[axes], direction[axes]
    roots = np.roots([d @ d, 2 * o @ d, o @ o - body[1] ** 2])
    return None if np.iscomplex(roots).any() else origin + roots.min() * direction


def radiance(ray, body, affine, light, paint, counts, seed):
    """Light that one ray brings back."""
    origin, direction = ray
    p = hit(origin, direction, body)
    if p is None:
        return 0.0
    material = p
    if body[0] == PLATE:
        material = np.array([*(affine[:4].reshape(2, 2) @ p[:2] + affine[4:]), 0.0])
    n, v = normal_at(p, body), -direction / np.linalg.norm(direction)
    if n @ v <= 0 or abs(material[0]) > body[2] or abs(material[1]) > body[3]:
        return 0.0
    cover, _, slope = paint_at(material, body, paint, counts, seed)
    m = (n - slope) / np.linalg.norm(n - slope)
    albedo, gloss, variance = ((1 - cover) * paint[a] + cover * paint[a + 5] for a in (7, 10, 11))
    way = light[:3] - p
    square = way @ way
    way = way / math.sqrt(square)
    if n @ way <= 0 or m @ way <= 0:
        return 0.0
    half = (way + v) / np.linalg.norm(way + v)
    masking = min(1, 2 * (m @ half) * min(m @ v, m @ way) / (v @ half))
    shiny = gloss * math.exp((m @ half - 1) / variance) * masking / (m @ v) if m @ v > 0 else 0.0
    return light[3] / square * (albedo * min(m @ way, 2 * (n @ way)) + shiny)


def trace(shape, samples, weights, pad, lens, frame, body, affine, lights, surface):
    """Image (k, H, W): every pixel the weighted sum of the radiances around it."""
    setup = SimpleNamespace(origin=frame[:3], turn=frame[3:].reshape(3, 3))
    paint, counts, seed = surface
    out = np.zeros((len(lights), *shape))
    for row, column in np.ndindex(*shape):
        for b, wy in enumerate(weights):
            for a, wx in enumerate(weights):
                x = column - pad + (a + 0.5) / samples - 0.5
                y = row - pad + (b + 0.5) / samples - 0.5
                pin = np.array([(x - lens[1]) / lens[0], (y - lens[2]) / lens[0], 1.0])
                ray = setup.origin, setup.turn @ pin
                for j, light in enumerate(lights):
                    out[j, row, column] += wx * wy * radiance(ray, body, affine, light, paint, counts, int(seed))
    return out
