"""Ray tracing of a painted body under point lights: one ray per sub-pixel sample, everything in the body's frame.

Paint is a function of the material point alone. Droplets are discs hashed from the cells of a three-dimensional lattice
(a Boolean model in a shell about the surface); wrinkles are gradient noise (Perlin, "Improving noise", SIGGRAPH 2002)
on a rotated three-dimensional lattice: plate, cylinder and sphere carry the same paint, without chart or seam.

Parameter vectors (float64)
    lens    [focal length px, centre x, centre y, magnification, shift x, shift y]
    frame   [camera centre in the body's frame (3), rotation camera -> body row by row (9)]
    body    [kind, radius, half width, half height]; limits are material, along x and y
    affine  [m00, m01, m10, m11, t0, t1], spatial -> material point of a plate
    paint   [cell, half shell, reach, median radius, size spread, softness, dome height,
             then for white and for black: albedo, slope scale, wrinkle lattice, gloss, lobe variance]

The samples of a tile lie in the rows of a work array, so that the compiler can vectorise the loops over them.
"""

from __future__ import annotations

import math

import numpy as np

from rgbmidic._kernels.compilation import compiled, helper
from rgbmidic._kernels.threads import over_ranges

__all__ = ["CYLINDER", "PLATE", "SPHERE", "filter_columns", "sample_paint", "trace_rows"]

PLATE, CYLINDER, SPHERE = 0, 1, 2
TILE = 8
MAX_CANDIDATES = 1024
_POINTS = 256
"""Points whose droplets `sample_paint` gathers together."""
_SQRT6 = math.sqrt(6.0)

# Rows of the work array: spatial point, material point, normal, direction to the camera, micro-normal, paint, pixel.
_X, _Y, _Z, _MX, _MY, _MZ, _NX, _NY, _NZ, _VX, _VY, _VZ, _FX, _FY, _FZ = range(15)
_SEEN, _COVER, _HEIGHT, _DX, _DY, _DZ, _ALBEDO, _GLOSS, _VARIANCE, _ENERGY, _EXPONENT = range(15, 26)
_CX, _CY = 26, 27
_FIELDS = 28

# A rotation about (1, 1, 1): no axis of the body lies near a plane of the wrinkle lattice.
_A, _B, _C = 0.80473785, -0.31061722, 0.50587936


@helper()
def _hash(i, j, k, seed):
    """32 random bits of a lattice point (finaliser: "lowbias32" of C. Wellons)."""
    h = np.uint32(np.uint32(i) * np.uint32(0x8DA6B343))
    h = np.uint32(h + np.uint32(np.uint32(j) * np.uint32(0xD8163841)))
    h = np.uint32(h + np.uint32(np.uint32(k) * np.uint32(0xCB1AB31F)))
    return _mix(np.uint32(h ^ seed))


@helper()
def _mix(h):
    h = np.uint32(np.uint32(h ^ np.uint32(h >> np.uint32(16))) * np.uint32(0x7FEB352D))
    h = np.uint32(np.uint32(h ^ np.uint32(h >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.uint32(h ^ np.uint32(h >> np.uint32(16)))


@helper()
def _unit(h):
    """A hash as a number in [0, 1)."""
    return np.float64(h) * (1.0 / 4294967296.0)


@helper()
def _fade(t):
    return t * t * t * (t * (t * np.float32(6.0) - np.float32(15.0)) + np.float32(10.0))


@helper()
def _fade_slope(t):
    rest = t * (t - np.float32(1.0))
    return np.float32(30.0) * rest * rest


@helper()
def _corner(h, u, v, w, wu, wv, ww, du, dv, dw):
    """One lattice corner's share of the noise and of its gradient."""
    scale, one = np.float32(2.0 / 1023.0), np.float32(1.0)
    p = np.float32(np.int32(h & np.uint32(1023))) * scale - one
    q = np.float32(np.int32((h >> np.uint32(10)) & np.uint32(1023))) * scale - one
    r = np.float32(np.int32((h >> np.uint32(20)) & np.uint32(1023))) * scale - one
    dot = p * u + q * v + r * w
    vw, weight = wv * ww, wu * wv * ww
    return weight * dot, weight * p + dot * du * vw, weight * q + dot * wu * dv * ww, weight * r + dot * wu * wv * dw


@helper()
def _enter_lattice(work, grid, cells, paint):
    """Position of the samples in the wrinkle lattice: cell and place within it."""
    for s in range(work.shape[1]):
        inverse = 1.0 / (paint[9] if work[_COVER, s] < 0.5 else paint[14])
        x, y, z = work[_MX, s] * inverse, work[_MY, s] * inverse, work[_MZ, s] * inverse
        u, v, w = _A * x + _B * y + _C * z, _C * x + _A * y + _B * z, _B * x + _C * y + _A * z
        i, j, k = math.floor(u), math.floor(v), math.floor(w)
        cells[0, s], cells[1, s], cells[2, s] = np.int32(i), np.int32(j), np.int32(k)
        grid[0, s], grid[1, s], grid[2, s] = np.float32(u - i), np.float32(v - j), np.float32(w - k)


@helper()
def _noise(grid, cells, seed):
    """Gradient noise (row 3 of `grid`) and its gradient (rows 4 to 6), in lattice units and axes."""
    one = np.float32(1.0)
    for s in range(grid.shape[1]):
        u, v, w = grid[0, s], grid[1, s], grid[2, s]
        u1, v1, w1 = u - one, v - one, w - one
        a, b, c, d, e, f = _fade(u), _fade(v), _fade(w), _fade_slope(u), _fade_slope(v), _fade_slope(w)
        a0, b0, c0 = one - a, one - b, one - c
        i, j, k = cells[0, s], cells[1, s], cells[2, s]
        i1, j1, k1 = np.int32(i + 1), np.int32(j + 1), np.int32(k + 1)
        n0, p0, q0, r0 = _corner(_hash(i, j, k, seed), u, v, w, a0, b0, c0, -d, -e, -f)
        n1, p1, q1, r1 = _corner(_hash(i1, j, k, seed), u1, v, w, a, b0, c0, d, -e, -f)
        n2, p2, q2, r2 = _corner(_hash(i, j1, k, seed), u, v1, w, a0, b, c0, -d, e, -f)
        n3, p3, q3, r3 = _corner(_hash(i1, j1, k, seed), u1, v1, w, a, b, c0, d, e, -f)
        n4, p4, q4, r4 = _corner(_hash(i, j, k1, seed), u, v, w1, a0, b0, c, -d, -e, f)
        n5, p5, q5, r5 = _corner(_hash(i1, j, k1, seed), u1, v, w1, a, b0, c, d, -e, f)
        n6, p6, q6, r6 = _corner(_hash(i, j1, k1, seed), u, v1, w1, a0, b, c, -d, e, f)
        n7, p7, q7, r7 = _corner(_hash(i1, j1, k1, seed), u1, v1, w1, a, b, c, d, e, f)
        grid[3, s] = ((n0 + n1) + (n2 + n3)) + ((n4 + n5) + (n6 + n7))
        grid[4, s] = ((p0 + p1) + (p2 + p3)) + ((p4 + p5) + (p6 + p7))
        grid[5, s] = ((q0 + q1) + (q2 + q3)) + ((q4 + q5) + (q6 + q7))
        grid[6, s] = ((r0 + r1) + (r2 + r3)) + ((r4 + r5) + (r6 + r7))


@helper()
def _gather(found, x, y, z, slack, body, paint, counts, seed):
    """Droplets (centre on the surface, radius) that can touch a point within `slack` of the given one; their number."""
    cell, reach = paint[0], paint[2] + slack
    margin = 0.87 * cell + paint[1]
    n = 0
    for i in range(math.floor((x - reach) / cell), math.floor((x + reach) / cell) + 1):
        for j in range(math.floor((y - reach) / cell), math.floor((y + reach) / cell) + 1):
            for k in range(math.floor((z - reach) / cell), math.floor((z + reach) / cell) + 1):
                height, _, _, _ = _to_surface((i + 0.5) * cell, (j + 0.5) * cell, (k + 0.5) * cell, body)
                if abs(height) <= margin:
                    h = _hash(np.int32(i), np.int32(j), np.int32(k), seed)
                    n = _throw(found, n, i, j, k, h, x, y, z, slack, body, paint, counts)
    return n


@helper()
def _to_surface(x, y, z, body):
    """Height of a point above the body's surface, and the surface point below it."""
    if body[0] == PLATE:
        return z, x, y, 0.0
    length = math.sqrt(x * x + z * z + (y * y if body[0] == SPHERE else 0.0))
    scale = body[1] / max(length, 1e-12)
    return length - body[1], x * scale, y * scale if body[0] == SPHERE else y, z * scale


@helper()
def _throw(found, n, i, j, k, h, x, y, z, slack, body, paint, counts):
    """Append the droplets of one cell that lie near enough."""
    cell, chance, number = paint[0], _unit(h), 0
    while number < counts.size and chance >= counts[number]:
        number += 1
    step = np.uint32(0x9E3779B9)
    for _ in range(number):
        h = _mix(np.uint32(h + step))
        cz = (k + _unit(h)) * cell
        h = _mix(np.uint32(h + step))
        cx = (i + _unit(h)) * cell
        h = _mix(np.uint32(h + step))
        cy = (j + _unit(h)) * cell
        h = _mix(np.uint32(h + step))
        height, cx, cy, cz = _to_surface(cx, cy, cz, body)
        if abs(height) > paint[1]:
            continue
        # two uniforms: a triangular law of unit variance, so that radii are bounded
        size = np.float64(h & np.uint32(65535)) / 65536.0 + np.float64(h >> np.uint32(16)) / 65536.0 - 1.0
        radius = paint[3] * math.exp(paint[4] * _SQRT6 * size)
        far = radius + 0.5 * paint[5] + slack
        if (cx - x) ** 2 + (cy - y) ** 2 + (cz - z) ** 2 <= far * far and n < found.shape[0]:
            found[n, 0], found[n, 1], found[n, 2], found[n, 3] = cx, cy, cz, radius
            n += 1
    return n


@helper()
def _coat(work, found, n, paint):
    """Cover by black paint (0 to 1) of the samples, with height and slope of the droplet on top."""
    inverse, dome = 1.0 / max(paint[5], 1e-9), paint[6]
    for s in range(work.shape[1]):
        work[_COVER, s] = work[_HEIGHT, s] = work[_DX, s] = work[_DY, s] = work[_DZ, s] = 0.0
    for c in range(n):
        x, y, z, radius = found[c, 0], found[c, 1], found[c, 2], found[c, 3]
        for s in range(work.shape[1]):
            dx, dy, dz = work[_MX, s] - x, work[_MY, s] - y, work[_MZ, s] - z
            inside = (radius - math.sqrt(dx * dx + dy * dy + dz * dz)) * inverse + 0.5
            work[_COVER, s] = max(work[_COVER, s], inside)
        if dome > 0.0:
            _dome(work, x, y, z, radius, dome)
    for s in range(work.shape[1]):
        t = min(work[_COVER, s], 1.0)
        work[_COVER, s] = t * t * (3.0 - 2.0 * t)


@helper()
def _dome(work, x, y, z, radius, dome):
    """Height dome (1 - r**2)**2 of one droplet, where it is the highest."""
    for s in range(work.shape[1]):
        dx, dy, dz = work[_MX, s] - x, work[_MY, s] - y, work[_MZ, s] - z
        rest = 1.0 - (dx * dx + dy * dy + dz * dz) / (radius * radius)
        if rest > 0.0 and dome * rest * rest > work[_HEIGHT, s]:
            normal = dx * work[_NX, s] + dy * work[_NY, s] + dz * work[_NZ, s]
            slope = -4.0 * dome * rest / (radius * radius)
            work[_HEIGHT, s] = dome * rest * rest
            work[_DX, s] = slope * (dx - normal * work[_NX, s])
            work[_DY, s] = slope * (dy - normal * work[_NY, s])
            work[_DZ, s] = slope * (dz - normal * work[_NZ, s])


@helper()
def _relief(work, grid, cells, paint, seed):
    """Add the wrinkles to height and slope."""
    _enter_lattice(work, grid, cells, paint)
    _noise(grid, cells, seed)
    for s in range(work.shape[1]):
        cover = work[_COVER, s]
        scale = (1.0 - cover) * paint[8] + cover * paint[13]
        work[_HEIGHT, s] += scale * (paint[9] if cover < 0.5 else paint[14]) * grid[3, s]
        p, q, r = scale * grid[4, s], scale * grid[5, s], scale * grid[6, s]
        gx, gy, gz = _A * p + _C * q + _B * r, _B * p + _A * q + _C * r, _C * p + _B * q + _A * r
        normal = gx * work[_NX, s] + gy * work[_NY, s] + gz * work[_NZ, s]
        work[_DX, s] += gx - normal * work[_NX, s]
        work[_DY, s] += gy - normal * work[_NY, s]
        work[_DZ, s] += gz - normal * work[_NZ, s]


@helper()
def _finish(work, paint):
    """Micro-normal and reflection properties of the samples."""
    for s in range(work.shape[1]):
        fx, fy, fz = work[_NX, s] - work[_DX, s], work[_NY, s] - work[_DY, s], work[_NZ, s] - work[_DZ, s]
        inverse = 1.0 / math.sqrt(fx * fx + fy * fy + fz * fz)
        work[_FX, s], work[_FY, s], work[_FZ, s] = fx * inverse, fy * inverse, fz * inverse
        cover = work[_COVER, s]
        work[_ALBEDO, s] = (1.0 - cover) * paint[7] + cover * paint[12]
        work[_GLOSS, s] = (1.0 - cover) * paint[10] + cover * paint[15]
        work[_VARIANCE, s] = (1.0 - cover) * paint[11] + cover * paint[16]


@helper()
def _locate(work, x0, y0, lens, frame, body, affine):
    """Where the rays through the pixels (x0 + `_CX`, y0 + `_CY`) meet the body; `_SEEN` is 1 or 0."""
    scale = 1.0 / (lens[0] * (1.0 + lens[3]))
    x0, y0 = x0 - lens[1] - lens[4], y0 - lens[2] - lens[5]
    # the surface is quadric . (x², y², z²) = 1 along the axes it curves about, or the plane z = 0
    ax, ay = 0.0 if body[0] == PLATE else 1.0, 1.0 if body[0] == SPHERE else 0.0
    ox, oy, oz = frame[0], frame[1], frame[2]
    rest = ax * (ox * ox + oz * oz) + ay * oy * oy - body[1] * body[1]
    for s in range(work.shape[1]):
        cx, cy = (x0 + work[_CX, s]) * scale, (y0 + work[_CY, s]) * scale
        dx = frame[3] * cx + frame[4] * cy + frame[5]
        dy = frame[6] * cx + frame[7] * cy + frame[8]
        dz = frame[9] * cx + frame[10] * cy + frame[11]
        inverse = -1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
        work[_VX, s], work[_VY, s], work[_VZ, s] = dx * inverse, dy * inverse, dz * inverse
    for s in range(work.shape[1]):
        dx, dy, dz = -work[_VX, s], -work[_VY, s], -work[_VZ, s]
        square = ax * (dx * dx + dz * dz) + ay * dy * dy
        half = ax * (ox * dx + oz * dz) + ay * oy * dy
        root = half * half - square * rest
        plane, curved = -oz / dz, (-half - math.sqrt(max(root, 0.0))) / square
        t = plane if ax == 0.0 else curved
        work[_SEEN, s] = 1.0 if (t > 0.0) & ((root > 0.0) | (ax == 0.0)) else 0.0
        work[_X, s], work[_Y, s], work[_Z, s] = ox + t * dx, oy + t * dy, oz + t * dz
    _settle(work, body, affine)


@helper()
def _settle(work, body, affine):
    """Material point and normal of the points hit; none where the surface turns its back."""
    plate, round_y = body[0] == PLATE, 1.0 if body[0] == SPHERE else 0.0
    curvature = 0.0 if plate else 1.0 / body[1]
    back = -1.0 if plate else 0.0
    thick = 0.0 if plate else 1.0
    for s in range(work.shape[1]):
        x, y, z = work[_X, s], work[_Y, s], work[_Z, s]
        work[_MX, s] = affine[0] * x + affine[1] * y + affine[4]
        work[_MY, s] = affine[2] * x + affine[3] * y + affine[5]
        work[_MZ, s] = thick * z
        work[_NX, s], work[_NY, s], work[_NZ, s] = curvature * x, curvature * round_y * y, curvature * z + back
    for s in range(work.shape[1]):
        facing = work[_NX, s] * work[_VX, s] + work[_NY, s] * work[_VY, s] + work[_NZ, s] * work[_VZ, s]
        work[_SEEN, s] = work[_SEEN, s] if facing > 0.0 else 0.0


@helper()
def _limit(work, body):
    """Nothing is seen beyond the body's edge."""
    for s in range(work.shape[1]):
        inside = abs(work[_MX, s]) <= body[2] and abs(work[_MY, s]) <= body[3]
        work[_SEEN, s] = work[_SEEN, s] if inside else 0.0


@helper()
def _spray(work, middle, found, body, paint, counts, seed):
    """Droplets of a tile: gathered once about its middle sample, or sample by sample where the tile spreads too far."""
    far = 0.0
    x, y, z = work[_MX, middle], work[_MY, middle], work[_MZ, middle]
    for s in range(work.shape[1]):
        square = (work[_MX, s] - x) ** 2 + (work[_MY, s] - y) ** 2 + (work[_MZ, s] - z) ** 2
        if not square <= far:
            far = square if square == square else 1e30
    if far <= (6.0 * paint[3]) ** 2:
        n = _gather(found, x, y, z, math.sqrt(far) + 1e-9, body, paint, counts, seed)
        _coat(work, found, n, paint)
        return
    one = np.empty((_FIELDS, 1))
    for s in range(work.shape[1]):
        n = 0
        if work[_SEEN, s] > 0.0:
            n = _gather(found, work[_MX, s], work[_MY, s], work[_MZ, s], 0.0, body, paint, counts, seed)
        for field in range(_FIELDS):
            one[field, 0] = work[field, s]
        _coat(one, found, n, paint)
        for field in range(_FIELDS):
            work[field, s] = one[field, 0]


@helper()
def _light(work, lights, j):
    """Radiance towards the camera in units of what an ideal white, facing the light at its nominal distance, gives.

    Lambert plus a micro-facet lobe exp((m.h - 1)/variance) with the masking of Cook and Torrance (1982).
    """
    px, py, pz, power = lights[j, 0], lights[j, 1], lights[j, 2], lights[j, 3]
    for s in range(work.shape[1]):
        lx, ly, lz = px - work[_X, s], py - work[_Y, s], pz - work[_Z, s]
        square = lx * lx + ly * ly + lz * lz
        inverse = 1.0 / math.sqrt(square)
        lx, ly, lz = lx * inverse, ly * inverse, lz * inverse
        vx, vy, vz = work[_VX, s], work[_VY, s], work[_VZ, s]
        nl = work[_NX, s] * lx + work[_NY, s] * ly + work[_NZ, s] * lz
        ml = work[_FX, s] * lx + work[_FY, s] * ly + work[_FZ, s] * lz
        mv = work[_FX, s] * vx + work[_FY, s] * vy + work[_FZ, s] * vz
        hx, hy, hz = lx + vx, ly + vy, lz + vz
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        mh = (ml + mv) / length
        lit = power / square if (work[_SEEN, s] > 0.0) & (nl > 0.0) & (ml > 0.0) else 0.0
        # a facet beyond twice its share is in the shadow of its neighbours: no step at the terminator
        work[_ENERGY, s] = lit * work[_ALBEDO, s] * min(ml, 2.0 * nl)
        reflected = lit * work[_GLOSS, s] if mv > 0.0 else 0.0
        work[_HEIGHT, s] = reflected * min(1.0, 4.0 * mh * min(mv, ml) / length) / max(mv, 1e-9)
        work[_EXPONENT, s] = (mh - 1.0) / work[_VARIANCE, s] if reflected > 0.0 else -1e9
    for s in range(work.shape[1]):
        if work[_EXPONENT, s] > -25.0:
            work[_ENERGY, s] += work[_HEIGHT, s] * math.exp(work[_EXPONENT, s])


@helper()
def _enter_tile(work, samples, width):
    """Pixel offsets of the samples of a tile, ordered by sub-row, sub-column and pixel."""
    s = 0
    for r in range(samples):
        for q in range(samples):
            for c in range(width):
                work[_CX, s], work[_CY, s] = c + q / samples, r / samples
                s += 1


@helper()
def _enter_material(work, samples, width, material, row, left):
    """Material points of a tile, taken from those of all samples; `row` and `left` are the first sub-pixel's."""
    s = 0
    for r in range(samples):
        for q in range(samples):
            for c in range(width):
                column = left + c * samples + q
                work[_MX, s], work[_MY, s] = material[row + r, column, 0], material[row + r, column, 1]
                s += 1


@helper()
def _collect(line, work, left, width):
    """Radiance of a tile's samples into `line` (sub-row, sub-column, pixel), from pixel `left`."""
    s = 0
    for r in range(line.shape[0]):
        for q in range(line.shape[0]):
            for c in range(width):
                line[r, q, left + c] = work[_ENERGY, s] if work[_SEEN, s] > 0.0 else 0.0
                s += 1


@over_ranges("out", axis=1)
@compiled()
def trace_rows(
    start, stop, out, first_row, taps, pad, lens, frame, body, affine, material, lights, paint, counts, seed
):
    """Radiance of every light along sub-pixel rows, filtered along x to whole pixels.

    Parameters
    ----------
    out : (k, n, samples, W) float32
        Written: light j on the sub-pixel rows of n rows of pixels.
    first_row : int
        First sub-pixel row; row r lies at y = (r + 1/2)/samples - 1/2 px.
    pad : int
        Pixels rendered beyond the frame on each side.
    taps : (samples (2 pad + 1),) float64
        Pixel aperture and lens blur along x.
    material : (n, samples (W + 2 pad), 2) float64, or empty
        Material point of every sample, where it is not the affine image of the spatial one.
    lights : (k, 4)
        Position in the body's frame and power.
    """
    samples, across = out.shape[2], out.shape[3] + 2 * pad
    found = np.empty((MAX_CANDIDATES, 4))
    line = np.empty((lights.shape[0], samples, samples, across), dtype=np.float32)
    wrinkles = np.uint32(seed ^ np.uint32(0x5BD1E995))
    for block in range(start, stop):
        y0 = (first_row + block * samples + 0.5) / samples - 0.5
        for left in range(0, across, TILE):
            width = min(TILE, across - left)
            number = samples * samples * width
            work = np.empty((_FIELDS, number))
            grid, cells = np.empty((7, number), dtype=np.float32), np.empty((3, number), dtype=np.int32)
            _enter_tile(work, samples, width)
            _locate(work, left - pad + 0.5 / samples - 0.5, y0, lens, frame, body, affine)
            if material.size > 0:
                _enter_material(work, samples, width, material, block * samples, left * samples)
            _limit(work, body)
            _spray(work, number // 2 + width // 2, found, body, paint, counts, seed)
            _relief(work, grid, cells, paint, wrinkles)
            _finish(work, paint)
            for j in range(lights.shape[0]):
                _light(work, lights, j)
                _collect(line[j], work, left, width)
        for j in range(lights.shape[0]):
            for r in range(samples):
                _decimate(out[j, block, r], line[j, r], taps)


@helper()
def _decimate(out, line, taps):
    """Weighted sums of the sub-pixel samples (sub-column, pixel) of a row, one per pixel."""
    samples = line.shape[0]
    total = np.zeros(out.size)
    for q in range(taps.size):
        weight, part, shift = taps[q], line[q % samples], q // samples
        for c in range(out.size):
            total[c] += weight * part[shift + c]
    for c in range(out.size):
        out[c] = total[c]


@over_ranges("out", axis=1)
@compiled()
def filter_columns(start, stop, out, rows, samples, taps):
    """Pixel aperture and lens blur along y: sub-pixel rows (k, n, W) to pixel rows `out` (k, h, W)."""
    total = np.empty(out.shape[2])
    for r in range(start, stop):
        for j in range(out.shape[0]):
            for c in range(out.shape[2]):
                total[c] = 0.0
            for q in range(taps.size):
                weight, line = taps[q], rows[j, r * samples + q]
                for c in range(out.shape[2]):
                    total[c] += weight * line[c]
            for c in range(out.shape[2]):
                out[j, r, c] = total[c]


@over_ranges("out", grain=_POINTS)
@compiled()
def sample_paint(start, stop, out, points, body, paint, counts, seed):
    """Cover, height (mm) and slope vector of the paint at points on the body: `out` (N, 5)."""
    for first in range(start, stop, _POINTS):
        number = min(_POINTS, stop - first)
        found = np.empty((MAX_CANDIDATES, 4))
        work = np.zeros((_FIELDS, number))
        grid, cells = np.empty((7, number), dtype=np.float32), np.empty((3, number), dtype=np.int32)
        for p in range(number):
            x, y, z = points[first + p, 0], points[first + p, 1], points[first + p, 2]
            work[_MX, p], work[_MY, p], work[_MZ, p] = x, y, z
            work[_SEEN, p], work[_NZ, p] = 1.0, -1.0
            if body[0] != PLATE:
                work[_NX, p], work[_NZ, p] = x / body[1], z / body[1]
                work[_NY, p] = y / body[1] if body[0] == SPHERE else 0.0
        _spray(work, work.shape[1] // 2, found, body, paint, counts, seed)
        _relief(work, grid, cells, paint, np.uint32(seed ^ np.uint32(0x5BD1E995)))
        for p in range(number):
            for column in range(5):
                out[first + p, column] = work[_COVER + column, p]
