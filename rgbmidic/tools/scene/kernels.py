"""Ray tracing of a painted body under point lights: one ray per sub-pixel sample, everything in the body's frame.

Paint is a function of the material point alone. Droplets are discs hashed from the cells of a three-dimensional lattice
(a Boolean model in a shell about the surface); wrinkles are gradient noise (Perlin, "Improving noise", SIGGRAPH 2002)
on a rotated three-dimensional lattice: plate, cylinder and sphere carry the same paint, without chart or seam.

Parameter vectors (float64)
    lens    [focal length px, centre x, centre y]
    frame   [camera centre in the body's frame (3), rotation camera -> body row by row (9)]
    body    [kind, radius, half width, half height]; limits are material, along x and y
    affine  [m00, m01, m10, m11, t0, t1], spatial -> material point of a plate
    paint   [cell, half shell, reach, median radius, size spread, softness, dome height,
             then for white and for black: albedo, slope scale, wrinkle lattice, gloss, lobe variance]

The samples of a tile lie in the rows of work arrays, so that the compiler can vectorise the loops over them: places in
float64, what is derived from the distance to the middle of the tile in float32.
"""

from __future__ import annotations

import math

import numpy as np

from rgbmidic._kernels.threads import compiled, helper

PLATE, CYLINDER, SPHERE = 0, 1, 2
TILE = 4
"""Side (px) of the squares whose droplets `trace_rows` gathers together."""
MAX_CANDIDATES = 1024
_CY, _CZ, _CR = MAX_CANDIDATES, 2 * MAX_CANDIDATES, 3 * MAX_CANDIDATES
_POINTS = 256
"""Points whose droplets `sample_paint` gathers together."""
_SQRT6 = math.sqrt(6.0)

_ROW = (64 * TILE) ** 2 + 16
"""Length of the rows of the work arrays, which are flat: the compiler must know how far apart rows lie to vectorise."""
# Rows of samples: spatial point, material point less the middle one, paint and slope, facet's normal, seen or not.
_X, _Y, _Z, _MX, _MY, _MZ, _COVER, _HEIGHT, _DX, _DY, _DZ, _FX, _FY, _FZ, _VISIBLE = range(0, 15 * _ROW, _ROW)

# A rotation about (1, 1, 1): no axis of the body lies near a plane of the wrinkle lattice.
_A, _B, _C = 0.80473785, -0.31061722, 0.50587936
_AS, _BS, _CS = np.float32(_A), np.float32(_B), np.float32(_C)
_PI, _PJ, _PK = 0x8DA6B343, 0xD8163841, 0xCB1AB31F
_STEP, _WRINKLES = 0x9E3779B9, 0x5BD1E995
_UNIT = 1 / 2**32
"""By which 32 random bits become a number in [0, 1)."""
# a number of Python's own would make the sums float64, which takes twice as long
_ZERO, _HALF, _ONE, _TWO, _THREE, _FOUR = (np.float32(value) for value in (0.0, 0.5, 1.0, 2.0, 3.0, 4.0))
_SIX, _TEN, _FIFTEEN, _THIRTY = (np.float32(value) for value in (6.0, 10.0, 15.0, 30.0))


@helper()
def _mix(h):
    """32 random bits from the last 32 of a number (finaliser: "lowbias32" of C. Wellons)."""
    h = np.uint32(h)
    h = np.uint32((h ^ (h >> 16)) * 0x7FEB352D)
    h = np.uint32((h ^ (h >> 15)) * 0x846CA68B)
    return np.uint32(h ^ (h >> 16))


_MIDDLE, _PER_GRADIENT = np.float32(511.5), np.float32(2.0 / 1023.0)


@helper()
def _corner(h, u, v, w, wu, wv, ww, du, dv, dw):
    """One lattice corner's part of the noise and of its gradient."""
    h = _mix(h)
    p = np.float32(np.int32(h & 1023)) - _MIDDLE
    q = np.float32(np.int32(h >> 10 & 1023)) - _MIDDLE
    r = np.float32(np.int32(h >> 20 & 1023)) - _MIDDLE
    dot = p * u + q * v + r * w
    vw, weight = wv * ww, wu * wv * ww
    return weight * dot, weight * p + dot * du * vw, weight * q + dot * wu * dv * ww, weight * r + dot * wu * wv * dw


@helper()
def _fade(t):
    """Weight of the far corner along one axis, and its slope."""
    product = t * (t - _ONE)
    return t * t * t * (t * (t * _SIX - _FIFTEEN) + _TEN), _THIRTY * product * product


@helper(forceinline=True)  # the loop that calls it is vectorised only without the call
def _noise(h, u, v, w, seed):
    """Gradient noise and its gradient, in lattice units and axes; h is the cell's number before the last mixing."""
    u1, v1, w1 = u - _ONE, v - _ONE, w - _ONE
    a, d = _fade(u)
    b, e = _fade(v)
    c, f = _fade(w)
    a0, b0, c0 = _ONE - a, _ONE - b, _ONE - c
    n0, p0, q0, r0 = _corner(h ^ seed, u, v, w, a0, b0, c0, -d, -e, -f)
    n1, p1, q1, r1 = _corner(np.uint32(h + _PI) ^ seed, u1, v, w, a, b0, c0, d, -e, -f)
    n2, p2, q2, r2 = _corner(np.uint32(h + _PJ) ^ seed, u, v1, w, a0, b, c0, -d, e, -f)
    n3, p3, q3, r3 = _corner(np.uint32(h + (_PI + _PJ)) ^ seed, u1, v1, w, a, b, c0, d, e, -f)
    n4, p4, q4, r4 = _corner(np.uint32(h + _PK) ^ seed, u, v, w1, a0, b0, c, -d, -e, f)
    n5, p5, q5, r5 = _corner(np.uint32(h + (_PI + _PK)) ^ seed, u1, v, w1, a, b0, c, d, -e, f)
    n6, p6, q6, r6 = _corner(np.uint32(h + (_PJ + _PK)) ^ seed, u, v1, w1, a0, b, c, -d, e, f)
    n7, p7, q7, r7 = _corner(np.uint32(h + (_PI + _PJ + _PK)) ^ seed, u1, v1, w1, a, b, c, d, e, f)
    return (
        _PER_GRADIENT * (((n0 + n1) + (n2 + n3)) + ((n4 + n5) + (n6 + n7))),
        _PER_GRADIENT * (((p0 + p1) + (p2 + p3)) + ((p4 + p5) + (p6 + p7))),
        _PER_GRADIENT * (((q0 + q1) + (q2 + q3)) + ((q4 + q5) + (q6 + q7))),
        _PER_GRADIENT * (((r0 + r1) + (r2 + r3)) + ((r4 + r5) + (r6 + r7))),
    )


@helper()
def _gather(droplets, x, y, z, slack, body, paint, counts, seed):
    """Droplets (centre on the surface less the given point, radius) that can touch a point within `slack` of it."""
    cell, reach, n = paint[0], paint[2] + slack, 0
    margin = 0.87 * cell + paint[1]
    for i in range(math.floor((x - reach) / cell), math.floor((x + reach) / cell) + 1):
        for j in range(math.floor((y - reach) / cell), math.floor((y + reach) / cell) + 1):
            for k in range(math.floor((z - reach) / cell), math.floor((z + reach) / cell) + 1):
                height, _, _, _ = _to_surface((i + 0.5) * cell, (j + 0.5) * cell, (k + 0.5) * cell, body)
                if abs(height) <= margin:
                    h = _mix(i * _PI + j * _PJ + k * _PK ^ seed)
                    n = _throw(droplets, n, i, j, k, h, x, y, z, slack, body, paint, counts)
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
def _throw(droplets, n, i, j, k, h, x, y, z, slack, body, paint, counts):
    """Append the droplets of one cell that lie near enough."""
    cell, widest, chance, number = paint[0], paint[2] + slack, h * _UNIT, 0
    while number < counts.size and chance >= counts[number]:
        number += 1
    for _ in range(number):
        hz = _mix(h + _STEP)
        hx = _mix(hz + _STEP)
        hy = _mix(hx + _STEP)
        h = _mix(hy + _STEP)
        height, cx, cy, cz = _to_surface(
            (i + hx * _UNIT) * cell, (j + hy * _UNIT) * cell, (k + hz * _UNIT) * cell, body
        )
        cx, cy, cz = cx - x, cy - y, cz - z
        square = cx * cx + cy * cy + cz * cz
        if abs(height) > paint[1] or square > widest * widest:
            continue
        # two uniforms: a triangular law of unit variance, so that radii are bounded
        size = (h & 65535) / 65536 + (h >> 16) / 65536 - 1.0
        radius = paint[3] * math.exp(paint[4] * _SQRT6 * size)
        far = radius + 0.5 * paint[5] + slack
        if square <= far * far and n < MAX_CANDIDATES:
            droplets[n], droplets[_CY + n], droplets[_CZ + n], droplets[_CR + n] = cx, cy, cz, radius
            n += 1
    return n


@helper()
def _curve(body):
    """Return a, b and c, with which the unit normal at a point (x, y, z) is (a x, b y, a z + c)."""
    if body[0] == PLATE:
        return _ZERO, _ZERO, -_ONE
    a = np.float32(1.0 / body[1])
    return a, a if body[0] == SPHERE else _ZERO, _ZERO


@helper()
def _coat(work, count, droplets, n, body, paint):
    """Cover by black paint (0 to 1) of the samples, with height and slope of the droplet on top."""
    inverse, dome = np.float32(1.0 / max(paint[5], 1e-9)), np.float32(paint[6])
    for s in range(count):
        work[_COVER + s] = work[_HEIGHT + s] = work[_DX + s] = work[_DY + s] = work[_DZ + s] = _ZERO
    for c in range(n):
        x, y, z, radius = droplets[c], droplets[_CY + c], droplets[_CZ + c], droplets[_CR + c]
        for s in range(count):
            dx, dy, dz = work[_MX + s] - x, work[_MY + s] - y, work[_MZ + s] - z
            inside = (radius - math.sqrt(dx * dx + dy * dy + dz * dz)) * inverse + _HALF
            work[_COVER + s] = max(work[_COVER + s], inside)
        if dome > _ZERO:
            _dome(work, count, x, y, z, radius, dome, body)
    for s in range(count):
        t = min(work[_COVER + s], _ONE)
        work[_COVER + s] = t * t * (_THREE - _TWO * t)


@helper()
def _dome(work, count, x, y, z, radius, dome, body):
    """Height dome (1 - r**2)**2 of one droplet, where it is the highest."""
    a, b, c = _curve(body)
    inverse = _ONE / (radius * radius)
    for s in range(count):
        dx, dy, dz = work[_MX + s] - x, work[_MY + s] - y, work[_MZ + s] - z
        falloff = _ONE - (dx * dx + dy * dy + dz * dz) * inverse
        if falloff > _ZERO and dome * falloff * falloff > work[_HEIGHT + s]:
            nx, ny, nz = a * work[_X + s], b * work[_Y + s], a * work[_Z + s] + c
            normal = dx * nx + dy * ny + dz * nz
            slope = -_FOUR * dome * falloff * inverse
            work[_HEIGHT + s] = dome * falloff * falloff
            work[_DX + s] = slope * (dx - normal * nx)
            work[_DY + s] = slope * (dy - normal * ny)
            work[_DZ + s] = slope * (dz - normal * nz)


@helper()
def _enter_lattice(x, y, z, lattice):
    """Return the point's cell of the wrinkle lattice as a number for hashing, and its place in that cell."""
    x, y, z = x / lattice, y / lattice, z / lattice
    u, v, w = _A * x + _B * y + _C * z, _C * x + _A * y + _B * z, _B * x + _C * y + _A * z
    i, j, k = math.floor(u), math.floor(v), math.floor(w)
    return np.uint32(i * _PI + j * _PJ + k * _PK), np.float32(u - i), np.float32(v - j), np.float32(w - k)


@helper()
def _floor(x):
    """Return the whole number below x (not by a call of the compiler's: the loops that use it are vectorised)."""
    i = np.int32(x)
    return np.int32(i - (np.float32(i) > x))


@helper()
def _relief(work, count, x, y, z, body, paint, seed):
    """Add the wrinkles to height and slope; the facets' normals."""
    a, b, c = _curve(body)
    white, black = np.float32(paint[9]), np.float32(paint[14])
    steep_white, steep_black = np.float32(paint[8]), np.float32(paint[13])
    per_white, per_black = _ONE / white, _ONE / black
    cell_white, uw, vw, ww = _enter_lattice(x, y, z, paint[9])
    cell_black, ub, vb, wb = _enter_lattice(x, y, z, paint[14])
    for s in range(count):
        cover = work[_COVER + s]
        bright = cover < _HALF
        per = per_white if bright else per_black
        x, y, z = work[_MX + s] * per, work[_MY + s] * per, work[_MZ + s] * per
        u = (uw if bright else ub) + (_AS * x + _BS * y + _CS * z)
        v = (vw if bright else vb) + (_CS * x + _AS * y + _BS * z)
        w = (ww if bright else wb) + (_BS * x + _CS * y + _AS * z)
        i, j, k = _floor(u), _floor(v), _floor(w)
        steps = i * _PI + j * _PJ + k * _PK
        cell = np.uint32((cell_white if bright else cell_black) + steps)
        noise, p, q, r = _noise(cell, u - np.float32(i), v - np.float32(j), w - np.float32(k), seed)
        scale = steep_white + cover * (steep_black - steep_white)
        work[_HEIGHT + s] += scale * (white if bright else black) * noise
        p, q, r = scale * p, scale * q, scale * r
        gx, gy, gz = _AS * p + _CS * q + _BS * r, _BS * p + _AS * q + _CS * r, _CS * p + _BS * q + _AS * r
        nx, ny, nz = a * work[_X + s], b * work[_Y + s], a * work[_Z + s] + c
        normal = gx * nx + gy * ny + gz * nz
        dx = work[_DX + s] + gx - normal * nx
        dy = work[_DY + s] + gy - normal * ny
        dz = work[_DZ + s] + gz - normal * nz
        work[_DX + s], work[_DY + s], work[_DZ + s] = dx, dy, dz
        nx, ny, nz = nx - dx, ny - dy, nz - dz
        inverse = _ONE / math.sqrt(nx * nx + ny * ny + nz * nz)
        work[_FX + s], work[_FY + s], work[_FZ + s] = nx * inverse, ny * inverse, nz * inverse


@helper()
def _paint(work, material_points, count, middle, droplets, body, paint, counts, seed):
    """Paint of a tile: droplets gathered once about its middle, or point by point where the tile spreads too far."""
    far = 0.0
    x, y, z = material_points[middle], material_points[_ROW + middle], material_points[2 * _ROW + middle]
    for s in range(count):
        dx, dy, dz = material_points[s] - x, material_points[_ROW + s] - y, material_points[2 * _ROW + s] - z
        square = dx * dx + dy * dy + dz * dz
        if not square <= far:
            far = square if square == square else 1e30
    step, slack = count, math.sqrt(far) + 1e-9
    if far > 36.0 * paint[3] * paint[3]:
        step, slack = 1, 0.0
    for first in range(0, count, step):
        if step == 1:
            x, y, z = material_points[first], material_points[_ROW + first], material_points[2 * _ROW + first]
        if step > 1 or work[_VISIBLE + first] > _ZERO:
            group, at = work[first:], material_points[first:]
            for s in range(step):
                group[_MX + s], group[_MY + s], group[_MZ + s] = at[s] - x, at[_ROW + s] - y, at[2 * _ROW + s] - z
            n = _gather(droplets, x, y, z, slack, body, paint, counts, seed)
            _coat(group, step, droplets, n, body, paint)
            _relief(group, step, x, y, z, body, paint, seed ^ _WRINKLES)


@helper()
def _locate(work, material_points, rows, span, samples, x0, y0, lens, frame, body, affine):
    """Intersect the rays through the sub-pixels (x0 + i, y0 + r) with the body; `_VISIBLE` is 1 or 0."""
    scale = 1.0 / (lens[0] * samples)
    # the surface is quadric . (x², y², z²) = 1 along the axes it curves about, or the plane z = 0
    flat = body[0] == PLATE
    ax, ay = 0.0 if flat else 1.0, 1.0 if body[0] == SPHERE else 0.0
    ox, oy, oz = frame[0], frame[1], frame[2]
    constant = ax * (ox * ox + oz * oz) + ay * oy * oy - body[1] * body[1]
    for r in range(rows):
        cy = (y0 + r) * scale
        rx, ry, rz = frame[4] * cy + frame[5], frame[7] * cy + frame[8], frame[10] * cy + frame[11]
        row, at = work[r * span :], material_points[r * span :]
        for i in range(span):
            cx = (x0 + i) * scale
            dx, dy, dz = frame[3] * cx + rx, frame[6] * cx + ry, frame[9] * cx + rz
            square = ax * (dx * dx + dz * dz) + ay * dy * dy
            half = ax * (ox * dx + oz * dz) + ay * oy * dy
            root = half * half - square * constant
            t = -oz / dz if flat else (-half - math.sqrt(max(root, 0.0))) / square
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            row[_X + i], row[_Y + i], row[_Z + i] = x, y, z
            row[_VISIBLE + i] = _ONE if (t > 0.0) & ((oz < 0.0) if flat else (root > 0.0)) else _ZERO
            at[i] = affine[0] * x + affine[1] * y + affine[4]
            at[_ROW + i] = affine[2] * x + affine[3] * y + affine[5]
            at[2 * _ROW + i] = ax * z


_FAINT, _SIXTYFOURTH = np.float32(-25.0), np.float32(1 / 64)
_THIRD, _QUARTER, _FIFTH = (np.float32(1 / n) for n in (3, 4, 5))


@helper()
def _exp(x):
    """exp(x) of x <= 0, within 5e-6 of its value where it exceeds 1e-4, never below exp(-25): a polynomial squared."""
    x = max(x, _FAINT) * _SIXTYFOURTH
    y = _ONE + x * (_ONE + _HALF * x * (_ONE + _THIRD * x * (_ONE + _QUARTER * x * (_ONE + _FIFTH * x))))
    for _ in range(6):
        y *= y
    return y


@helper()
def _light(energy, first_column, work, rows, span, lights, j, frame, body, paint):
    """Radiance towards the camera in units of what an ideal white, facing the light at its nominal distance, gives.

    Lambert plus a micro-facet lobe exp((m.h - 1)/variance) with the masking of Cook and Torrance (1982).
    """
    a, b, c = _curve(body)
    px, py, pz = np.float32(lights[j, 0]), np.float32(lights[j, 1]), np.float32(lights[j, 2])
    ox, oy, oz, power = np.float32(frame[0]), np.float32(frame[1]), np.float32(frame[2]), np.float32(lights[j, 3])
    albedo, gloss, variance = np.float32(paint[7]), np.float32(paint[10]), np.float32(paint[11])
    more, glossier = np.float32(paint[12]) - albedo, np.float32(paint[15]) - gloss
    broader = np.float32(paint[16]) - variance
    for r in range(rows):
        line, row = energy[r][first_column:], work[r * span :]
        for s in range(span):
            x, y, z, cover = row[_X + s], row[_Y + s], row[_Z + s], row[_COVER + s]
            lx, ly, lz, vx, vy, vz = px - x, py - y, pz - z, ox - x, oy - y, oz - z
            square = _ONE / (lx * lx + ly * ly + lz * lz)
            near, view = math.sqrt(square), _ONE / math.sqrt(vx * vx + vy * vy + vz * vz)
            fx, fy, fz = row[_FX + s], row[_FY + s], row[_FZ + s]
            nl = (a * x * lx + b * y * ly + (a * z + c) * lz) * near
            ml = (fx * lx + fy * ly + fz * lz) * near
            mv = (fx * vx + fy * vy + fz * vz) * view
            length = math.sqrt(_TWO + _TWO * (lx * vx + ly * vy + lz * vz) * near * view)
            mh = (ml + mv) / length
            # a facet beyond twice its share is in the shadow of its neighbours: no step at the terminator
            diffuse = (albedo + cover * more) * min(ml, _TWO * nl)
            masking = min(_ONE, _FOUR * mh * min(mv, ml) / length) / mv
            shiny = (gloss + cover * glossier) * masking * _exp((mh - _ONE) / (variance + cover * broader))
            total = diffuse + (shiny if mv > _ZERO else _ZERO)
            line[s] = power * square * total if (row[_VISIBLE + s] > _ZERO) & (nl > _ZERO) & (ml > _ZERO) else _ZERO


@compiled("out", axis=1, grain=TILE, min_size=0)
def trace_rows(
    start, stop, out, first_row, taps, pad, lens, frame, body, affine, material, lights, paint, counts, seed
):
    """Radiance of every light along sub-pixel rows, filtered along x to whole pixels.

    Parameters
    ----------
    start, stop
        Range of rows of pixels that this call does.
    lens, frame, body, affine, paint
        Parameter vectors, see the module.
    counts : (n,)
        Probabilities up to which a cell's number of droplets is 0, 1 and so on.
    seed
        Of the paint.
    out : (k, n, samples, W) float32
        Written: light j on the sub-pixel rows of n rows of pixels.
    first_row : int
        First sub-pixel row; row r lies at y = (r + 1/2)/samples - 1/2 px.
    pad : int
        Pixels rendered beyond the frame on each side.
    taps : (samples (2 pad + 1),) float32
        Pixel aperture and lens blur along x.
    material : (n, samples (W + 2 pad), 2) float64, or empty
        Material point of every sample, where it is not the affine image of the spatial one.
    lights : (k, 4)
        Position in the body's frame and power.
    """
    samples, across, side = out.shape[2], out.shape[2] * (out.shape[3] + 2 * pad), out.shape[2] * TILE
    work, material_points = np.empty(15 * _ROW, dtype=np.float32), np.empty(3 * _ROW)
    droplets = np.empty(4 * MAX_CANDIDATES, dtype=np.float32)
    energy = np.empty(lights.shape[0] * side * across, dtype=np.float32).reshape(lights.shape[0], side, across)
    x0, y0 = 0.5 - samples * (0.5 + lens[1] + pad), 0.5 - samples * (0.5 + lens[2]) + first_row
    for block in range(start, stop, TILE):
        top, rows = block * samples, min(side, (stop - block) * samples)
        for first_column in range(0, across, side):
            span = min(side, across - first_column)
            count = rows * span
            _locate(work, material_points, rows, span, samples, x0 + first_column, y0 + top, lens, frame, body, affine)
            if material.size > 0:
                for s in range(count):
                    row, column = top + s // span, first_column + s % span
                    material_points[s], material_points[_ROW + s] = material[row, column, 0], material[row, column, 1]
            for s in range(count):  # nothing is seen beyond the body's edge
                inside = (abs(material_points[s]) <= body[2]) & (abs(material_points[_ROW + s]) <= body[3])
                work[_VISIBLE + s] = work[_VISIBLE + s] if inside else _ZERO
            _paint(work, material_points, count, (count + span) // 2, droplets, body, paint, counts, seed)
            for j in range(lights.shape[0]):
                _light(energy[j], first_column, work, rows, span, lights, j, frame, body, paint)
        for j in range(lights.shape[0]):
            for r in range(rows):
                _decimate(out[j, block + r // samples, r % samples], energy[j, r], samples, taps)


@helper(fastmath={"reassoc", "contract"})
def _decimate(out, line, samples, taps):
    """Weighted sums of the sub-pixel samples of a row, one per pixel."""
    for c in range(out.size):
        total, window = _ZERO, line[c * samples :]
        for q in range(taps.size):
            total += taps[q] * window[q]
        out[c] = total


@compiled("out", grain=_POINTS, min_size=0)
def sample_paint(start, stop, out, points, body, paint, counts, seed):
    """Cover, height (mm) and slope vector of the paint at points on the body: `out` (N, 5)."""
    for first in range(start, stop, _POINTS):
        number = min(_POINTS, stop - first)
        droplets = np.empty(4 * MAX_CANDIDATES, dtype=np.float32)
        work, material_points = np.empty(15 * _ROW, dtype=np.float32), np.empty(3 * _ROW)
        for p in range(number):
            x, y, z = points[first + p, 0], points[first + p, 1], points[first + p, 2]
            material_points[p], material_points[_ROW + p], material_points[2 * _ROW + p] = x, y, z
            work[_X + p], work[_Y + p], work[_Z + p], work[_VISIBLE + p] = x, y, z, _ONE
        _paint(work, material_points, number, number // 2, droplets, body, paint, counts, seed)
        for p in range(number):
            for column in range(5):
                out[first + p, column] = work[_COVER + column * _ROW + p]
