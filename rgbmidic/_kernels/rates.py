"""Compiled loops of the rates: pieces of a series that polynomials fit, their probabilities, and means over them.

The ways to cut a series into pieces are summed over exactly, as by Fearnhead (Stat Comput 16, 2006); the likelihood of
a piece is Schwarz's (Ann Stat 6, 1978), with a price for each parameter in place of an integral over all of them.
"""

import numpy as np

from rgbmidic._kernels.threads import compiled, helper

LOWEST, HIGHEST = 2, 4
"""Degrees of the polynomials. A fifth follows sharp pulses better (160 standard uncertainties a square frame: 2.3 times
the stated error in the worst frame, not 3.3), but states the acceleration of a swing 1.8 times too large, not 1.4."""
_NOISE = 1.2
"""What the stated noise is multiplied by where pieces are chosen: errors are .9 to 1.2 times what is stated of them
(docs: uncertainty). A piece that by chance begins a frame too early is doubtful then: without it what is false before
an onset was up to 8 times the stated in 400 draws, with it 5.6."""
_PRICE, _CUT_PARAMETERS = 3.5, 2
"""Price of a parameter in units of chi-square (Schwarz: the logarithm of the number of values, here 33), and parameters
that the place of a piece counts for: chosen from 2.5 to 5 and 1 to 4 on signals that benchmarks/rates.py does not use.
At a lower price rates are noisier at rest, at a higher one the jerk that begins a pulse is overlooked."""
_OLD, _FAINT, _ROOM = 3, 6.0, 16
"""A piece's start is followed for so many windows, whatever its odds (a weak kink takes two to show), and longer if its
log odds are above `-_FAINT`, 1 in 400, and it is among the so many first of those."""
_CORRELATION = 0.7
"""Correlation from frame to frame of what a variance exceeds those around it by, as while a reflection passes: .69 of
the strain in travelling glare (benchmarks/hole_trial.py); .58 to .72 makes a slope over 7 to 11 frames least certain
(derived)."""
_NONE = np.int64(-1)
"""No index; a literal would compile what it is given to once more."""
_NEVER = 12.0
"""Log odds under those of the best cut at this place below which a start cannot come back."""
_MIN_PROBABILITY, _NOTHING = 3e-4, -30.0
"""Probability from which a window counts (from 1e-3 on the acceleration of a pulse is beyond 1.3 times the stated in
11 % of its frames, not in 4 %; from 1e-4 on a swing takes 1.5 times as long), and logarithm of what adds nothing to 1.
"""


@helper()
def _add_row(corner, rotated, row, x, value, weight):
    """Add an equation to a triangular system (Givens rotations) and return the residual of its right side."""
    row[0] = weight
    for j in range(HIGHEST):
        row[j + 1] = row[j] * x
    residual = value * weight
    for j in range(HIGHEST + 1):
        length = np.sqrt(corner[j, j] ** 2 + row[j] ** 2)
        if length == 0.0:
            continue
        c, s = corner[j, j] / length, row[j] / length
        for k in range(j, HIGHEST + 1):
            corner[j, k], row[k] = c * corner[j, k] + s * row[k], c * row[k] - s * corner[j, k]
        rotated[j], residual = c * rotated[j] + s * residual, c * residual - s * rotated[j]
    return residual


@helper()
def _pieces(t, y, w, young, starts, ends, logs, before):
    """Likely pieces of a series and their log likelihoods by degree, in the order of their ends; returns how many.

    `before` (n + 1,) receives the log likelihood of what lies before each frame, summed over all ways to cut it.
    """
    n, room, count, n_open = t.size, young + _ROOM + 1, np.int64(0), 0
    corner, rotated = np.zeros((room, HIGHEST + 1, HIGHEST + 1)), np.zeros((room, HIGHEST + 1))
    square_sums, origin, odds = np.zeros(room), np.zeros(room, dtype=np.int64), np.zeros(room)
    row = np.zeros(HIGHEST + 1)
    before[:] = -np.inf
    before[0] = 0.0
    for b in range(n):
        if before[b] > -np.inf:
            corner[n_open], rotated[n_open], square_sums[n_open], origin[n_open] = 0.0, 0.0, 0.0, b
            n_open += 1
        first, best = count, -np.inf
        for i in range(n_open):
            a = origin[i]
            square_sums[i] += _add_row(corner[i], rotated[i], row, t[b] - t[a], y[b] - y[a], w[b]) ** 2
            odds[i] = -np.inf
            if b - a < LOWEST:
                continue
            starts[count], ends[count], logs[count] = a, b, -np.inf
            square_sum = square_sums[i]
            for d in range(HIGHEST, LOWEST - 1, -1):
                if d <= b - a:
                    logs[count, d - LOWEST] = -0.5 * (square_sum / _NOISE**2 + _PRICE * (d + 1 + _CUT_PARAMETERS))
                    odds[i] = max(odds[i], before[a] + logs[count, d - LOWEST])
                square_sum += rotated[i, d] ** 2
            best = max(best, odds[i])
            count += 1
        total = 0.0
        for p in range(first, count):
            for k in range(HIGHEST - LOWEST + 1):
                term = before[starts[p]] + logs[p, k] - best
                total += np.exp(term) if term > _NOTHING else 0.0
        if total > 0.0:
            before[b + 1] = best + np.log(total)
        n_kept = 0
        for i in range(n_open):
            length = b - origin[i] + 1
            # whoever cuts here pays one price more, and fits no worse
            never = length > HIGHEST and odds[i] < best - 0.5 * _PRICE * (LOWEST + 1 + _CUT_PARAMETERS) - _NEVER
            if never or (length >= young and (odds[i] < best - _FAINT or n_kept == _ROOM)):
                continue
            square_sums[n_kept], origin[n_kept] = square_sums[i], origin[i]
            for j in range(HIGHEST + 1):  # one assignment of slices in this file takes numba 3 s more to compile
                rotated[n_kept, j] = rotated[i, j]
                for k in range(HIGHEST + 1):
                    corner[n_kept, j, k] = corner[i, j, k]
            n_kept += 1
        n_open = n_kept
    return count


@helper()
def _probabilities(n, count, starts, ends, logs, before):
    """Replace log likelihoods of pieces by their probabilities, given the whole series."""
    high, total, log_after = np.full(n + 1, -np.inf), np.zeros(n + 1), 0.0
    high[n], total[n] = 0.0, 1.0
    for p in range(count - 1, -1, -1):
        a, b = starts[p], ends[p]
        if p == count - 1 or b != ends[p + 1]:
            log_after = high[b + 1] + np.log(total[b + 1]) if total[b + 1] > 0 else -np.inf
        for k in range(logs.shape[1]):
            term = logs[p, k] + log_after
            if term > high[a]:
                total[a] = total[a] * np.exp(high[a] - term) + 1.0
                high[a] = term
            elif term > high[a] + _NOTHING:
                total[a] += np.exp(term - high[a])
            odds = before[a] + term - before[n]
            logs[p, k] = np.exp(odds) if odds > _NOTHING else 0.0


@helper()
def _orthonormal(t, w, first, last, top, norms, shifts, values):
    """Polynomials (top + 1, frames) orthonormal under the squares of `w` over known frames (Forsythe, 1957)."""
    for k in range(top + 1):
        total = shift = 0.0
        for j in range(first, last + 1):
            q = j - first
            if k == 0:
                values[0, q] = 1.0
            else:
                x = t[j] - shifts[k - 1]
                values[k, q] = x * values[k - 1, q] - (norms[k - 1] * values[k - 2, q] if k > 1 else 0.0)
            total += (w[j] * values[k, q]) ** 2
        norms[k] = np.sqrt(total)
        for j in range(first, last + 1):
            values[k, j - first] /= norms[k]
            shift += t[j] * (w[j] * values[k, j - first]) ** 2
        shifts[k] = shift


@helper()
def _at(x, top, norms, shifts, out):
    """Those polynomials and their first two derivatives at the time x, (3, top + 1)."""
    out[0, 0], out[1, 0], out[2, 0] = 1.0 / norms[0], 0.0, 0.0
    for k in range(1, top + 1):
        for o in range(3):
            value = (x - shifts[k - 1]) * out[o, k - 1] + (o * out[o - 1, k - 1] if o else 0.0)
            out[o, k] = (value - (norms[k - 1] * out[o, k - 2] if k > 1 else 0.0)) / norms[k]


@helper()
def _rate_of_onset(y, w, neighbour, interval, line, z, degree):
    """Rate at an end of a piece by a motion that sets in before it and shows in the neighbouring value first.

    What departs from the piece by a standard uncertainty s at its end is not seen. If it grows by a power of the time
    since the interval before, and is E at the neighbour, the power is log2(E / s), and its rate s times that power over
    the interval. E / s is taken as 1 + the excess of the departure from the tangent (`line`) over its noise.
    """
    tangent, variance = 0.0, 1 / w[neighbour] ** 2
    for k in range(degree + 1):
        tangent += line[k] * z[k]
        variance += line[k] ** 2
    excess = (y[neighbour] - tangent) ** 2 / variance - 1
    return np.log2(1 + np.sqrt(excess)) / (w[neighbour] * interval) if excess > 0 else 0.0


@helper()
def _add_window(t, y, w, first, last, chance, times, low, high, begin, end, base, work, sums, lines):
    """Add the fits of a window of known frames, of a probability for each degree, to the frames `low` to `high`.

    A fit counts by its probability over the standard uncertainty of its velocity: over the variance, what is false at
    an onset was up to 8 times the stated. `sums` (3, T, 3, 5) receives, for frames where the piece goes on to both
    sides, begins (`begin`) or ends (`end`), and for each derivative, the sums of weights, estimates, their squares,
    variances, and squares of `_rate_of_onset`; `lines` (T, 3, width) the weights of the values in the estimates.
    """
    norms, shifts, values, at, z, mixed, line = work
    top = _NONE
    for d in range(LOWEST, HIGHEST + 1):
        if chance[d - LOWEST] > _MIN_PROBABILITY and last - first >= d:
            top = np.int64(d)
    if top < 0:
        return
    _orthonormal(t, w, first, last, top, norms, shifts, values)
    for k in range(top + 1):
        z[k] = 0.0
        for j in range(first, last + 1):
            z[k] += w[j] ** 2 * values[k, j - first] * y[j]
    for i in range(low, high + 1):
        if times[i] < t[first] or times[i] > t[last]:
            continue
        _at(times[i], top, norms, shifts, at)
        group = 1 if i == begin else (2 if i == end else 0)
        mixed[:] = 0.0
        for d in range(LOWEST, top + 1):
            if chance[d - LOWEST] <= _MIN_PROBABILITY:
                continue
            spread = 0.0
            for k in range(d + 1):
                spread += at[1, k] ** 2
            weight = chance[d - LOWEST] / np.sqrt(spread)
            for is_at_end, neighbour in ((i == begin, first - 1), (i == end, last + 1)):
                if is_at_end and 0 <= neighbour < t.size:
                    interval = t[neighbour] - times[i]
                    for k in range(d + 1):
                        line[k] = at[0, k] + interval * at[1, k]
                    rate = _rate_of_onset(y, w, neighbour, interval, line, z, d)
                    sums[group, i, 1, 4] += weight * rate**2
            for o in range(3):
                estimate = variance = 0.0
                for k in range(d + 1):
                    estimate += at[o, k] * z[k]
                    variance += at[o, k] ** 2
                    mixed[o, k] += weight * at[o, k]
                sums[group, i, o, 0] += weight
                sums[group, i, o, 1] += weight * estimate
                sums[group, i, o, 2] += weight * estimate**2
                sums[group, i, o, 3] += weight * variance
        for o in range(3):
            for j in range(first, last + 1):
                total = 0.0
                for k in range(top + 1):
                    total += mixed[o, k] * values[k, j - first]
                lines[i, o, j - base[i]] += total * w[j] ** 2


@helper()
def _length(degree):
    """Length of a window for polynomials of a degree: as many frames for a coefficient as a parabola has in 1."""
    return (degree + 1) / (LOWEST + 1)


@helper()
def _average(t, y, w, frames, times, count, starts, ends, chances, base, work, sums, lines):
    """Sort pieces by the windows that they leave to each frame, and add the fits of all of these.

    A window has a length for each degree. A piece that is no longer is a window; a longer one leaves to each frame what
    reaches half as far to both sides, and next to its ends the windows there.
    """
    n = t.size
    window_chance, degrees = np.zeros(HIGHEST + 1 - LOWEST), HIGHEST + 1 - LOWEST
    beginning, ending, middle = np.zeros((n, degrees)), np.zeros((n, degrees)), np.zeros((times.size + 1, degrees))
    for p in range(count):
        a, b, short = starts[p], ends[p], False
        for k in range(degrees):
            chance, reach, window_chance[k] = chances[p, k], _length(LOWEST + k), 0.0
            if chance <= _MIN_PROBABILITY:
                continue
            if t[b] - t[a] <= reach:
                window_chance[k], short = chance, True
                continue
            beginning[a, k] += chance
            ending[b, k] += chance
        if short:
            low, high = frames[a], frames[b]
            _add_window(t, y, w, a, b, window_chance, times, low, high, low, high, base, work, sums, lines)
    for k in range(degrees):
        reach = _length(LOWEST + k)
        window_chance[:] = 0.0
        for j in range(n):
            frame, window_chance[k] = frames[j], beginning[j, k]
            if window_chance[k] > 0:
                last = np.searchsorted(t, t[j] + reach, side="right") - 1
                high = np.searchsorted(times, t[j] + reach / 2)
                _add_window(
                    t, y, w, j, last, window_chance, times, frame, high - 1, frame, _NONE, base, work, sums, lines
                )
                middle[high, k] += window_chance[k]
            window_chance[k] = ending[j, k]
            if window_chance[k] > 0:
                first = np.searchsorted(t, t[j] - reach)
                low = np.searchsorted(times, t[j] - reach / 2, side="right")
                _add_window(t, y, w, first, j, window_chance, times, low, frame, _NONE, frame, base, work, sums, lines)
                middle[low, k] -= window_chance[k]
        for i in range(times.size):
            if i:
                middle[i, k] += middle[i - 1, k]
            window_chance[k] = middle[i, k]
            if window_chance[k] > _MIN_PROBABILITY:
                first = np.searchsorted(t, times[i] - reach / 2)
                last = np.searchsorted(t, times[i] + reach / 2, side="right") - 1
                _add_window(t, y, w, first, last, window_chance, times, i, i, _NONE, _NONE, base, work, sums, lines)


@helper()
def _excess_std(t, w, out):
    """Root of what the variance of each value exceeds twice the least within a window to both sides by.

    Less is how variances differ from frame to frame without a reflection.
    """
    for j in range(t.size):
        out[j] = 0.0
        for k in range(np.searchsorted(t, t[j] - 1), np.searchsorted(t, t[j] + 1, side="right")):
            out[j] = max(out[j], 1 / w[j] ** 2 - 2 / w[k] ** 2)
        out[j] = np.sqrt(out[j])


@helper()
def _conclude(w, excess, frames, reference, base, sums, lines, out):
    """Means and their variances (2, 7, T) from what `_add_window` added up.

    The variance of the mean in noise, of which `excess` (n,) is correlated from frame to frame, the spread of what it
    is taken over, and what an onset hides next to the ends of pieces; for one side, where `lines` does not give the
    first, the mean of the variances. Of the value, the part that the reference adds to all is left out.
    """
    for i in range(base.size):
        for o in range(3):
            weight = sums[:, i, o, 0].sum()
            if weight == 0:
                continue
            mean, chance, passing, last = sums[:, i, o, 1].sum() / weight, 0.0, 0.0, base[i]
            for j in range(base[i], min(base[i] + lines.shape[2], frames.size)):
                line = lines[i, o, j - base[i]] / weight
                chance += (line**2 - (2 * line * reference[frames[j]] if o == 0 else 0.0)) / w[j] ** 2
                passing *= _CORRELATION ** (frames[j] - frames[last])
                chance += 2 * line * excess[j] * passing
                passing, last = passing + line * excess[j], j
            spread = max(sums[:, i, o, 2].sum() / weight - mean**2, 0.0)
            onset = sums[:, i, o, 4].sum() / weight
            out[0, o, i], out[1, o, i] = mean, chance + spread + onset
            for side in range(2 if o else 0):
                totals = sums[0, i, o] + sums[2 - side, i, o]
                if totals[0] > 0:
                    mean = totals[1] / totals[0]
                    out[0, o + 2 + 2 * side, i] = mean
                    out[1, o + 2 + 2 * side, i] = (totals[3] + totals[2]) / totals[0] - mean**2


@compiled("values", min_size=0)
def mean_rates(start, stop, times, values, noise, common, reference, max_frames, out):
    """Value, velocity and acceleration of series (N, T), those from before and from after each frame, and variances.

    `noise` (N, T) is the standard uncertainty of each value that is its own, 0 where it is not known, `common` (N, T)
    the variance that the reference adds to all of them, and `reference` (T,) the weight of each frame in the reference.
    Windows of the lowest degree are of length 1 (`times` rise) and hold `max_frames` at most. `out` (N, 2, 7, T), NaN,
    receives estimates and their variances: value, velocity, acceleration; velocity, acceleration before; those after.
    """
    size, reach = times.size, _length(HIGHEST)
    base, width = np.zeros(size, dtype=np.int64), 0
    for i in range(size):
        width = max(width, np.searchsorted(times, times[i] + 2 * reach, side="right") - i + 1)
    frames, t, y, w = np.zeros(size, dtype=np.int64), np.zeros(size), np.zeros(size), np.zeros(size)
    young = _OLD * max_frames
    room = size * (young + _ROOM + 1)
    starts, ends = np.zeros(room, dtype=np.int64), np.zeros(room, dtype=np.int64)
    logs, before = np.zeros((room, HIGHEST - LOWEST + 1)), np.zeros(size + 1)
    sums, lines, excess = np.zeros((3, size, 3, 5)), np.zeros((size, 3, width)), np.zeros(size)
    top = HIGHEST + 1
    work = (
        np.zeros(top),
        np.zeros(top),
        np.zeros((top, size)),
        np.zeros((3, top)),
        np.zeros(top),
        np.zeros((3, top)),
        np.zeros(top),
    )
    for column in range(start, stop):
        n, origin = np.int64(0), 0.0
        for i in range(size):
            if noise[column, i] > 0:
                origin = values[column, i] if n == 0 else origin
                frames[n], t[n], y[n], w[n] = i, times[i], values[column, i] - origin, 1 / noise[column, i]
                n += 1
        if n < LOWEST + 2:
            continue
        for i in range(size):
            base[i] = np.searchsorted(t[:n], times[i] - reach)
        count = _pieces(t[:n], y[:n], w[:n], young, starts, ends, logs, before[: n + 1])
        _probabilities(n, count, starts, ends, logs, before)
        sums[:], lines[:] = 0.0, 0.0
        _average(t[:n], y[:n], w[:n], frames, times, count, starts, ends, logs, base, work, sums, lines)
        _excess_std(t[:n], w[:n], excess)
        _conclude(w[:n], excess, frames[:n], reference, base, sums, lines, out[column])
        for i in range(size):
            out[column, 0, 0, i] += origin
            out[column, 1, 0, i] += common[column, i]
