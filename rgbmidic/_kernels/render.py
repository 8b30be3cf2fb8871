"""Ray tracing of a painted body under point lights: one ray per sub-pixel sample, everything in the body's frame.

Paint is a function of the material point alone. Droplets are discs hashed from the cells of a three-dimensional lattice
(a Boolean model in a shell about the surface); wrinkles are gradient noise (Perlin, "Improving noise", SIGGRAPH 2002)
on a rotated three-dimensional lattice: plate, cylinder and sphere carry the same paint, without chart or seam.

Parameter vectors (float64)
    camera  [focal length px, centre x, centre y, magnification, shift x, shift y]
    frame   [camera centre in the body's frame (3), rotation camera -> body row by row (9)]
    body    [kind, radius, half width, half height]; limits are material, along x and y
    affine  [m00, m01, m10, m11, t0, t1], spatial -> material point of a plate
    paint   [cell, half shell, reach, median radius, size spread, softness, dome height,
             then for white and for black: albedo, slope scale, wrinkle lattice, gloss, lobe variance]
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

__all__ = ["CYLINDER", "PLATE", "SPHERE", "filter_columns", "sample_paint", "trace_rows"]

PLATE, CYLINDER, SPHERE = 0, 1, 2
MAX_CANDIDATES = 512
_SQRT6 = math.sqrt(6.0)

# A rotation about (1, 1, 1): no axis of the body lies near a plane of the wrinkle lattice.
_A, _B, _C = 0.80473785, -0.31061722, 0.50587936


@njit(cache=True, nogil=True)
def _mix(h):
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(31))


@njit(cache=True, nogil=True)
def _hash(i, j, k, seed):
    h = np.uint64(i) * np.uint64(0x9E3779B97F4A7C15)
    h += np.uint64(j) * np.uint64(0xC2B2AE3D27D4EB4F)
    h += np.uint64(k) * np.uint64(0x165667B19E3779F9)
    return _mix(h ^ seed)


@njit(cache=True, nogil=True)
def _unit(h, shift):
    """21 bits of a hash as a number in [0, 1)."""
    return np.float64(np.int64((h >> np.uint64(shift)) & np.uint64(0x1FFFFF))) * (1.0 / 2097152.0)


@njit(cache=True, nogil=True)
def _fade(t):
    return t * t * t * (t * (t * 6 - 15) + 10)


@njit(cache=True, nogil=True)
def _fade_slope(t):
    return 30 * t * t * (t - 1) * (t - 1)


@njit(cache=True, nogil=True)
def wrinkle(x, y, z, seed):
    """Gradient noise and its gradient at a point in lattice units."""
    u = _A * x + _B * y + _C * z
    v = _C * x + _A * y + _B * z
    w = _B * x + _C * y + _A * z
    fi, fj, fk = math.floor(u), math.floor(v), math.floor(w)
    i, j, k = np.int64(fi), np.int64(fj), np.int64(fk)
    u -= fi
    v -= fj
    w -= fk
    su, sv, sw = _fade(u), _fade(v), _fade(w)
    tu, tv, tw = _fade_slope(u), _fade_slope(v), _fade_slope(w)
    value = gu = gv = gw = 0.0
    for c in range(8):
        a, b, d = c & 1, (c >> 1) & 1, c >> 2
        h = _hash(i + a, j + b, k + d, seed)
        p, q, r = 2 * _unit(h, 0) - 1, 2 * _unit(h, 21) - 1, 2 * _unit(h, 42) - 1
        wu, du = (su, tu) if a else (1 - su, -tu)
        wv, dv = (sv, tv) if b else (1 - sv, -tv)
        ww, dw = (sw, tw) if d else (1 - sw, -tw)
        dot = p * (u - a) + q * (v - b) + r * (w - d)
        weight = wu * wv * ww
        value += weight * dot
        gu += weight * p + dot * du * wv * ww
        gv += weight * q + dot * wu * dv * ww
        gw += weight * r + dot * wu * wv * dw
    return value, _A * gu + _C * gv + _B * gw, _B * gu + _A * gv + _C * gw, _C * gu + _B * gv + _A * gw


@njit(cache=True, nogil=True)
def gather(found, x, y, z, nx, ny, nz, slack, paint, counts, seed):
    """Droplets (centre, radius) that can touch a point within `slack` of the given one; returns how many."""
    cell, shell, reach = paint[0], paint[1] + 0.1 * slack, paint[2] + slack
    n = 0
    for i in range(math.floor((x - reach) / cell), math.floor((x + reach) / cell) + 1):
        for j in range(math.floor((y - reach) / cell), math.floor((y + reach) / cell) + 1):
            for k in range(math.floor((z - reach) / cell), math.floor((z + reach) / cell) + 1):
                middle = ((i + 0.5) * cell - x) * nx + ((j + 0.5) * cell - y) * ny + ((k + 0.5) * cell - z) * nz
                if abs(middle) > 0.5 * cell * (abs(nx) + abs(ny) + abs(nz)) + shell:
                    continue
                h = _hash(i, j, k, seed)
                u = _unit(h, 0)
                number = 0
                while number < counts.size and u >= counts[number]:
                    number += 1
                for _ in range(number):
                    h = _mix(h + np.uint64(0x9E3779B97F4A7C15))
                    dx, dy = (i + _unit(h, 0)) * cell - x, (j + _unit(h, 21)) * cell - y
                    dz = (k + _unit(h, 42)) * cell - z
                    h = _mix(h + np.uint64(0x9E3779B97F4A7C15))
                    # two uniforms: a triangular law of unit variance, so that radii are bounded
                    radius = paint[3] * math.exp(paint[4] * _SQRT6 * (_unit(h, 0) + _unit(h, 21) - 1.0))
                    normal = dx * nx + dy * ny + dz * nz
                    far = radius + 0.5 * paint[5] + slack
                    if abs(normal) > shell or dx * dx + dy * dy + dz * dz - normal * normal > far * far:
                        continue
                    if n < found.shape[0]:
                        found[n, 0], found[n, 1], found[n, 2], found[n, 3] = x + dx, y + dy, z + dz, radius
                        n += 1
    return n


@njit(cache=True, nogil=True)
def coat(found, n, x, y, z, nx, ny, nz, paint):
    """Cover by black paint (0 to 1) at a point, with the height and the slope of the droplet on top."""
    cover = height = sx = sy = sz = 0.0
    soft, dome = paint[5], paint[6]
    for c in range(n):
        dx, dy, dz = x - found[c, 0], y - found[c, 1], z - found[c, 2]
        normal = dx * nx + dy * ny + dz * nz
        radius = found[c, 3]
        square = dx * dx + dy * dy + dz * dz - normal * normal
        far = radius + 0.5 * soft
        if abs(normal) > paint[1] or square >= far * far:
            continue
        s = 1.0 if soft == 0.0 else min(1.0, (radius - math.sqrt(max(square, 0.0))) / soft + 0.5)
        cover = max(cover, s * s * (3.0 - 2.0 * s))
        relative = square / (radius * radius)
        if dome > 0.0 and relative < 1.0 and dome * (1.0 - relative) ** 2 > height:
            height = dome * (1.0 - relative) ** 2
            slope = -4.0 * dome * (1.0 - relative) / (radius * radius)
            sx, sy, sz = slope * (dx - normal * nx), slope * (dy - normal * ny), slope * (dz - normal * nz)
    return cover, height, sx, sy, sz


@njit(cache=True, nogil=True)
def relief(cover, x, y, z, nx, ny, nz, paint, seed):
    """Height and tangential slope of the wrinkles at a point."""
    lattice = paint[9] if cover < 0.5 else paint[14]
    scale = (1.0 - cover) * paint[8] + cover * paint[13]
    if scale == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    value, gx, gy, gz = wrinkle(x / lattice, y / lattice, z / lattice, seed)
    normal = gx * nx + gy * ny + gz * nz
    return scale * lattice * value, scale * (gx - normal * nx), scale * (gy - normal * ny), scale * (gz - normal * nz)


@njit(cache=True, nogil=True)
def radiance(light, x, y, z, n, m, v, albedo, gloss, variance):
    """Radiance towards the camera in units of what an ideal white, facing the light at its nominal distance, gives.

    Lambert plus a micro-facet lobe exp((m.h - 1)/variance) with the masking of Cook and Torrance (1982).
    """
    lx, ly, lz = light[0] - x, light[1] - y, light[2] - z
    square = lx * lx + ly * ly + lz * lz
    inverse = 1.0 / math.sqrt(square)
    lx, ly, lz = lx * inverse, ly * inverse, lz * inverse
    nl = n[0] * lx + n[1] * ly + n[2] * lz
    ml = m[0] * lx + m[1] * ly + m[2] * lz
    if nl <= 0.0 or ml <= 0.0:
        return 0.0
    # a facet beyond twice its share is in the shadow of its neighbours: no step at the terminator
    total = albedo * min(ml, 2.0 * nl)
    mv = m[0] * v[0] + m[1] * v[1] + m[2] * v[2]
    if gloss > 0.0 and mv > 0.0:
        hx, hy, hz = lx + v[0], ly + v[1], lz + v[2]
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        mh = (ml + mv) / length
        exponent = (mh - 1.0) / variance
        if exponent > -25.0:
            vh = 0.5 * length
            masking = min(1.0, 2.0 * mh * mv / vh, 2.0 * mh * ml / vh)
            total += gloss * math.exp(exponent) * masking / mv
    return light[3] / square * total


@njit(cache=True, nogil=True)
def hit(body, o, dx, dy, dz):
    """Distance along the ray to the body's front, or -1."""
    if body[0] == PLATE:
        return -o[2] / dz if dz != 0.0 else -1.0
    square, half, rest = dx * dx + dz * dz, o[0] * dx + o[2] * dz, o[0] * o[0] + o[2] * o[2]
    if body[0] == SPHERE:
        square, half, rest = square + dy * dy, half + o[1] * dy, rest + o[1] * o[1]
    rest -= body[1] * body[1]
    root = half * half - square * rest
    return (-half - math.sqrt(root)) / square if root > 0.0 else -1.0


@njit(cache=True, nogil=True, parallel=True)
def trace_rows(out, first_row, samples, taps, pad, camera, frame, body, affine, material, lights, paint, counts, seed):
    """Radiance of every light along sub-pixel rows, filtered along x to whole pixels.

    Parameters
    ----------
    out : (k, n, W) float32
        Written: light j on sub-pixel row ``first_row + i``.
    first_row : int
        First sub-pixel row; row r lies at y = (r + 1/2)/samples - 1/2 px.
    samples, pad : int
        Sub-pixel samples per pixel and direction; pixels rendered beyond the frame on each side.
    taps : (samples (2 pad + 1),) float64
        Pixel aperture and lens blur along x.
    material : (n, samples (W + 2 pad), 2) float64, or empty
        Material point of every sample, where it is not the affine image of the spatial one.
    lights : (k, 4)
        Position in the body's frame and power.
    """
    width = out.shape[2]
    columns = samples * (width + 2 * pad)
    slack = 0.5 * paint[3]
    for i in prange(out.shape[1]):
        line = np.zeros((lights.shape[0], columns), dtype=np.float32)
        found = np.empty((MAX_CANDIDATES, 4))
        near = np.full(3, 1e30)
        n, m, v = np.empty(3), np.empty(3), np.empty(3)
        count = 0
        cy = ((first_row + i + 0.5) / samples - 0.5 - camera[2] - camera[5]) / (camera[0] * (1.0 + camera[3]))
        for s in range(columns):
            cx = ((s + 0.5) / samples - 0.5 - pad - camera[1] - camera[4]) / (camera[0] * (1.0 + camera[3]))
            dx = frame[3] * cx + frame[4] * cy + frame[5]
            dy = frame[6] * cx + frame[7] * cy + frame[8]
            dz = frame[9] * cx + frame[10] * cy + frame[11]
            t = hit(body, frame, dx, dy, dz)
            if t <= 0.0:
                continue
            x, y, z = frame[0] + t * dx, frame[1] + t * dy, frame[2] + t * dz
            n[0], n[1], n[2] = 0.0, 0.0, -1.0
            mx, my, mz = x, y, z
            if body[0] == PLATE:
                mz = 0.0
                if material.size > 0:
                    mx, my = material[i, s, 0], material[i, s, 1]
                else:
                    mx = affine[0] * x + affine[1] * y + affine[4]
                    my = affine[2] * x + affine[3] * y + affine[5]
            else:
                n[0], n[2] = x / body[1], z / body[1]
                n[1] = y / body[1] if body[0] == SPHERE else 0.0
            inverse = -1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
            v[0], v[1], v[2] = dx * inverse, dy * inverse, dz * inverse
            facing = n[0] * v[0] + n[1] * v[1] + n[2] * v[2]
            if facing <= 0.0 or not (abs(mx) <= body[2] and abs(my) <= body[3]):
                continue
            if (mx - near[0]) ** 2 + (my - near[1]) ** 2 + (mz - near[2]) ** 2 > slack * slack:
                near[0], near[1], near[2] = mx, my, mz
                count = gather(found, mx, my, mz, n[0], n[1], n[2], slack, paint, counts, seed)
            cover, _, dsx, dsy, dsz = coat(found, count, mx, my, mz, n[0], n[1], n[2], paint)
            _, sx, sy, sz = relief(cover, mx, my, mz, n[0], n[1], n[2], paint, seed + np.uint64(1))
            m[0], m[1], m[2] = n[0] - sx - dsx, n[1] - sy - dsy, n[2] - sz - dsz
            length = 1.0 / math.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
            m[0], m[1], m[2] = m[0] * length, m[1] * length, m[2] * length
            albedo = (1.0 - cover) * paint[7] + cover * paint[12]
            gloss = (1.0 - cover) * paint[10] + cover * paint[15]
            variance = (1.0 - cover) * paint[11] + cover * paint[16]
            for j in range(lights.shape[0]):
                line[j, s] = radiance(lights[j], x, y, z, n, m, v, albedo, gloss, variance)
        for j in range(lights.shape[0]):
            for c in range(width):
                total = 0.0
                for q in range(taps.size):
                    total += taps[q] * line[j, c * samples + q]
                out[j, i, c] = total


@njit(cache=True, nogil=True, parallel=True)
def filter_columns(out, rows, samples, taps):
    """Pixel aperture and lens blur along y: sub-pixel rows (k, n, W) to pixel rows `out` (k, h, W)."""
    for r in prange(out.shape[1]):
        for j in range(out.shape[0]):
            total = np.zeros(out.shape[2])
            for q in range(taps.size):
                for c in range(out.shape[2]):
                    total[c] += taps[q] * rows[j, r * samples + q, c]
            for c in range(out.shape[2]):
                out[j, r, c] = total[c]


@njit(cache=True, nogil=True, parallel=True)
def sample_paint(out, points, normals, paint, counts, seed):
    """Cover, height (mm) and slope vector of the paint at material points: `out` (N, 5)."""
    for p in prange(points.shape[0]):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        nx, ny, nz = normals[p, 0], normals[p, 1], normals[p, 2]
        found = np.empty((MAX_CANDIDATES, 4))
        count = gather(found, x, y, z, nx, ny, nz, 0.0, paint, counts, seed)
        cover, height, dsx, dsy, dsz = coat(found, count, x, y, z, nx, ny, nz, paint)
        rise, sx, sy, sz = relief(cover, x, y, z, nx, ny, nz, paint, seed + np.uint64(1))
        out[p, 0], out[p, 1] = cover, height + rise
        out[p, 2], out[p, 3], out[p, 4] = sx + dsx, sy + dsy, sz + dsz
