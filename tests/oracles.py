"""Reference forms of every stage of the matching core: plain loops, written from the papers, slow and exact.

Nothing here imports stereokit. Conventions that papers leave open (ties, borders, rounding) are those that
the package documents. Disparity ``d`` of level ``k`` is ``k + minimum``; the right pixel is column ``x - d``;
volumes are ``(H, W, D)``.

References
----------
R. Zabih, J. Woodfill, "Non-parametric local transforms for computing visual correspondence", ECCV 1994.
H. Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008.
E. Gastal, M. Oliveira, "Domain transform for edge-aware image and video processing", SIGGRAPH 2011.
L. Di Stefano, M. Marchionni, S. Mattoccia, "A fast area-based stereo matching algorithm", IVC 2004.
Q. Chang et al., "StereoVAE", ICRA 2023.
"""

from __future__ import annotations

import math

import numpy as np

ACROSS = [(0, 1), (0, -1)]
FROM_ABOVE = [(1, 0), (1, 1), (1, -1)]
FROM_BELOW = [(-1, 0), (-1, 1), (-1, -1)]
DIRECTIONS = {4: [*ACROSS, (1, 0), (-1, 0)], 5: ACROSS + FROM_ABOVE, 8: ACROSS + FROM_ABOVE + FROM_BELOW}
"""Steps ``(dy, dx)`` from one pixel of a path to the next, by number of paths."""


def _clamped(image, y, x):
    height, width = image.shape
    return int(image[min(max(y, 0), height - 1), min(max(x, 0), width - 1)])


def _volume(left, right, minimum, count, cost, outside, dtype):
    """Fill a volume with ``cost(y, x, xr)``; cells to the side of the image get `outside`, if not None."""
    height, width = left.shape
    volume = np.empty((height, width, count), dtype)
    for y in range(height):
        for x in range(width):
            for k in range(count):
                xr = x - k - minimum
                is_out = outside is not None and not 0 <= xr < width
                volume[y, x, k] = outside if is_out else cost(y, x, xr)
    return volume


def census_bits(image, y, x, across, down):
    """Zabih and Woodfill's transform: which neighbours of the window are darker than the pixel."""
    centre = _clamped(image, y, x)
    offsets = [(dy, dx) for dy in range(-down, down + 1) for dx in range(-across, across + 1)]
    return [_clamped(image, y + dy, x + dx) < centre for dy, dx in offsets if (dy, dx) != (0, 0)]


def census(left, right, minimum, count, width=9, height=7, outside=1.0):
    """Hamming distances of census transforms; `outside` is a share of the largest, None clamps borders."""
    across, down = width // 2, height // 2
    largest = width * height - 1
    transforms = {}

    def bits(name, image, y, x):
        if (name, y, x) not in transforms:
            transforms[name, y, x] = census_bits(image, y, x, across, down)
        return transforms[name, y, x]

    def cost(y, x, xr):
        a, b = bits("left", left, y, x), bits("right", right, y, xr)
        return sum(p != q for p, q in zip(a, b, strict=True))

    worst = None if outside is None else round(outside * largest)
    return _volume(left, right, minimum, count, cost, worst, np.int64)


def zncc(left, right, minimum, count, window=5, outside=1.0):
    """``min(1 - rho, 1)`` in float64 (StereoVAE eq. 1-3); 1 where a window has no variance."""
    half = window // 2
    span = range(-half, half + 1)

    def patch(image, y, x):
        return [_clamped(image, y + dy, x + dx) for dy in span for dx in span]

    def cost(y, x, xr):
        a, b = patch(left, y, x), patch(right, y, xr)
        mean_a, mean_b = sum(a) / len(a), sum(b) / len(b)
        a, b = [v - mean_a for v in a], [v - mean_b for v in b]
        if len(set(a)) == 1 or len(set(b)) == 1:
            return 1.0
        product = sum(p * q for p, q in zip(a, b, strict=True))
        rho = product / (math.sqrt(sum(p * p for p in a)) * math.sqrt(sum(q * q for q in b)))
        return min(1 - rho, 1.0)

    return _volume(left, right, minimum, count, cost, outside, np.float64)


def sgm(volume, p1, p2, directions, guide=None, edge=0, edge_factor=1.0):
    """Sum over `directions` of the path costs (Hirschmueller 2008, eq. 13-14), in integers.

    Both penalties of a step between pixels whose values in `guide` differ by `edge` or more are multiplied by
    `edge_factor` and rounded.
    """
    height, width, count = volume.shape
    flat = p1, p2
    crossing = round(p1 * edge_factor), round(p2 * edge_factor)
    total = np.zeros(volume.shape, np.int64)
    for dy, dx in directions:
        path = np.zeros(volume.shape, np.int64)
        rows = range(height) if dy >= 0 else range(height - 1, -1, -1)
        columns = range(width) if dx >= 0 else range(width - 1, -1, -1)
        for y in rows:
            for x in columns:
                here = [int(c) for c in volume[y, x]]
                if 0 <= y - dy < height and 0 <= x - dx < width:
                    before = [int(c) for c in path[y - dy, x - dx]]
                    jump = 0 if guide is None else abs(int(guide[y, x]) - int(guide[y - dy, x - dx]))
                    p1, p2 = crossing if guide is not None and jump >= edge else flat
                    least = min(before)
                    for d in range(count):
                        best = min(before[d], least + p2)
                        if d > 0:
                            best = min(best, before[d - 1] + p1)
                        if d < count - 1:
                            best = min(best, before[d + 1] + p1)
                        here[d] += best - least
                path[y, x] = here
        total += path
    return total


def narrow_sgm(volume, starts, searched, p1, p2, directions):
    """Sum over `directions` of path costs where a pixel has only the `searched` levels from its start on.

    Levels that a pixel does not have offer nothing, neither to the next pixel nor to their neighbours at the pixel
    itself: of the three terms of Hirschmueller's eq. 13 that name a level, those remain that both pixels have. The sum
    of a level that a pixel does not have is -1.
    """
    height, width, _ = volume.shape
    total = np.full(volume.shape, -1, np.int64)
    for y in range(height):
        for x in range(width):
            total[y, x, starts[y, x] : starts[y, x] + searched] = 0
    for dy, dx in directions:
        paths = {}
        rows = range(height) if dy >= 0 else range(height - 1, -1, -1)
        columns = range(width) if dx >= 0 else range(width - 1, -1, -1)
        for y in rows:
            for x in columns:
                before = paths.get((y - dy, x - dx))
                own = range(starts[y, x], starts[y, x] + searched)
                here = {d: int(volume[y, x, d]) for d in own}
                if before is not None:
                    least = min(before.values())
                    for d in own:
                        terms = [least + p2]
                        for level, penalty in ((d, 0), (d - 1, p1), (d + 1, p1)):
                            if level in before and level in here:
                                terms.append(before[level] + penalty)
                        here[d] += min(terms) - least
                paths[y, x] = here
                for d in own:
                    total[y, x, d] += here[d]
    return total


def domain_transform(plane, guide, sigma_s, sigma_r, passes, sigma_v=None):
    """Recursive filter of one slice, ``(H, W)``, float64 (Gastal and Oliveira 2011, eq. 14 and 21).

    `sigma_v` is the spatial scale along columns where it differs from that along rows.
    """
    values = np.array(plane, np.float64)
    grey = np.array(guide, np.float64)
    along_columns = sigma_s if sigma_v is None else sigma_v
    for i in range(1, passes + 1):
        # Views: rows, then columns.
        for image, edges, scale in ((values, grey, sigma_s), (values.T, grey.T, along_columns)):
            sigma = scale * math.sqrt(3) * 2.0 ** (passes - i) / math.sqrt(4.0**passes - 1)
            a = math.exp(-math.sqrt(2) / sigma)
            for line, edge in zip(image, edges, strict=True):
                weight = [a ** (1 + scale / sigma_r * abs(edge[n] - edge[n - 1])) for n in range(1, len(line))]
                for n in range(1, len(line)):
                    line[n] += weight[n - 1] * (line[n - 1] - line[n])
                for n in range(len(line) - 2, -1, -1):
                    line[n] += weight[n] * (line[n + 1] - line[n])
    return values


def cascade(plane, guide):
    """Plain sum of the StereoVAE authors: right, left, down, up, each on what the last one left, float64."""
    values = np.array(plane, np.float64)
    grey = np.array(guide, np.int64)
    height, width = values.shape
    for y in range(height):
        for x in range(1, width):
            values[y, x] += math.exp(-abs(grey[y, x] - grey[y, x - 1]) / 52) * values[y, x - 1]
        for x in range(width - 2, -1, -1):
            values[y, x] += math.exp(-abs(grey[y, x] - grey[y, x + 1]) / 52) * values[y, x + 1]

    def vertical(jump):
        return 0.8 if jump < 5 else math.exp(-jump / 52)

    for x in range(width):
        for y in range(1, height):
            values[y, x] += vertical(abs(grey[y, x] - grey[y - 1, x])) * values[y - 1, x]
        for y in range(height - 2, -1, -1):
            values[y, x] += vertical(abs(grey[y, x] - grey[y + 1, x])) * values[y + 1, x]
    return values


def slices(filter_plane, volume, *arguments):
    """Apply a filter of one slice to every slice of a volume."""
    parts = [filter_plane(volume[:, :, d], *arguments) for d in range(volume.shape[2])]
    return np.stack(parts, axis=2)


def winner(costs, minimum=0, subpixel=True):
    """Return ``(disparity, cost, confidence)`` of one pixel: the lowest level of equals, a parabola."""
    costs = [float(c) for c in costs]
    best = min(costs)
    level = costs.index(best)
    disparity = level + minimum
    if subpixel and 0 < level < len(costs) - 1:
        before, behind = costs[level - 1], costs[level + 1]
        bend = before + behind - 2 * best
        if bend > 0:
            disparity += (before - behind) / (2 * bend)
    others = [c for k, c in enumerate(costs) if abs(k - level) > 1]
    if not others:
        return disparity, best, 1.0
    rival = min(others)
    return disparity, best, (rival - best) / rival if rival > 0 else 0.0


def select(volume, minimum=0, subpixel=True):
    """Winner takes all over a volume; three maps."""
    flat = [winner(costs, minimum, subpixel) for row in volume for costs in row]
    return tuple(np.array(part).reshape(volume.shape[:2]) for part in zip(*flat, strict=True))


def rivals(volume, minimum=0):
    """Return for every pixel the first of its cheapest levels that are not next to the winner, or else the winner."""

    def rival(costs):
        costs = [float(c) for c in costs]
        level = costs.index(min(costs))
        others = [k for k in range(len(costs)) if abs(k - level) > 1]
        return minimum + min(others, key=lambda k: (costs[k], k), default=level)

    return np.array([[rival(costs) for costs in row] for row in volume])


def single_matching_phase(disparity, cost):
    """Keep the cheapest of all pixels that match one right pixel (rounded); of equals the larger disparity."""
    height, width = disparity.shape
    out = np.full(disparity.shape, np.nan)
    for y in range(height):
        claims = {}
        for x in range(width):
            if not math.isnan(disparity[y, x]):
                claims.setdefault(math.floor(x - float(disparity[y, x]) + 0.5), []).append(x)
        for xr, columns in claims.items():
            if 0 <= xr < width:
                x = min(columns, key=lambda x, y=y: (cost[y, x], -disparity[y, x]))
                out[y, x] = disparity[y, x]
    return out


def fill(disparity, mode):
    """Fill gaps along rows, then rows without any value from the nearest that has some (upper of equals)."""
    out = np.array(disparity, np.float64)
    full = []
    for y, row in enumerate(disparity):
        known = [x for x in range(len(row)) if not math.isnan(row[x])]
        if known:
            full.append(y)
        for x in range(len(row)):
            before = [k for k in known if k <= x][-1:]
            behind = [k for k in known if k >= x][:1]
            ends = [(abs(x - k), float(row[k])) for k in before + behind]
            if ends:
                out[y, x] = min(ends)[1] if mode == "nearest" else min(value for _, value in ends)
    for y in range(len(out)):
        if full and y not in full:
            out[y] = out[min(full, key=lambda k, y=y: (abs(k - y), k))]
    return out


def median(disparity, size):
    """Median of the valid values of the window, borders replicated; the lower of the two middle ones."""
    height, width = disparity.shape
    half = size // 2
    out = np.full(disparity.shape, np.nan)
    for y in range(height):
        for x in range(width):
            if math.isnan(disparity[y, x]):
                continue
            window = [
                float(disparity[min(max(y + dy, 0), height - 1), min(max(x + dx, 0), width - 1)])
                for dy in range(-half, half + 1)
                for dx in range(-half, half + 1)
            ]
            window = sorted(v for v in window if not math.isnan(v))
            out[y, x] = window[(len(window) - 1) // 2]
    return out


def remove_speckles(disparity, size, difference=1.0):
    """Invalidate 4-connected regions of `size` pixels or fewer, by differences in sixteenths of a pixel."""
    height, width = disparity.shape
    out = np.array(disparity, np.float64)
    valid = [(y, x) for y in range(height) for x in range(width) if not math.isnan(disparity[y, x])]
    fixed = {at: round(16 * float(disparity[at])) for at in valid}
    while fixed:
        region, edge = [], [next(iter(fixed))]
        values = {edge[0]: fixed.pop(edge[0])}
        while edge:
            y, x = at = edge.pop()
            region.append(at)
            for near in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
                if near in fixed and abs(fixed[near] - values[at]) <= 16 * difference:
                    values[near] = fixed.pop(near)
                    edge.append(near)
        if len(region) <= size:
            for at in region:
                out[at] = math.nan
    return out


def gaussian(image, sigma):
    """Gaussian filter with replicated borders, cut at six sigma, float64."""
    radius = math.ceil(6 * sigma)
    taps = [math.exp(-(k * k) / (2 * sigma * sigma)) for k in range(-radius, radius + 1)]
    out = np.array(image, np.float64)
    for lines in (out, out.T):
        for line in lines:
            padded = [float(line[0])] * radius + [float(v) for v in line] + [float(line[-1])] * radius
            for n in range(len(line)):
                line[n] = sum(t * v for t, v in zip(taps, padded[n:], strict=False)) / sum(taps)
    return out


def halve(image):
    """Mean of each 2x2 pixels, float64; odd sizes are extended by their last row or column."""
    height, width = image.shape
    out = np.empty(((height + 1) // 2, (width + 1) // 2))
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            four = [_clamped(image, 2 * y + dy, 2 * x + dx) for dy in (0, 1) for dx in (0, 1)]
            out[y, x] = sum(four) / 4
    return out


def double(image, height, width):
    """Bilinear upscaling by two with pixel centres kept: full pixel i lies at ``(i + 0.5) / 2 - 0.5``."""

    def weights(i, size):
        at = (i + 0.5) / 2 - 0.5
        low = math.floor(at)
        ends = [(low, 1 - (at - low)), (low + 1, at - low)]
        return [(min(max(k, 0), size - 1), share) for k, share in ends]

    out = np.empty((height, width))
    for y in range(height):
        for x in range(width):
            out[y, x] = sum(
                a * b * float(image[j, i]) for j, a in weights(y, image.shape[0]) for i, b in weights(x, image.shape[1])
            )
    return out


def convolve(image, weight, bias, stride=1):
    """Convolution of (C, H, W) with (outputs, C, k, k) weights, the border padded with k // 2 zeros; float64."""
    channels, height, width = image.shape
    outputs, _, size, _ = weight.shape
    rows, columns = -(-height // stride), -(-width // stride)
    out = np.empty((outputs, rows, columns))
    for y in range(rows):
        for x in range(columns):
            total = np.array(bias, np.float64)
            for ky in range(size):
                for kx in range(size):
                    sy, sx = y * stride + ky - size // 2, x * stride + kx - size // 2
                    if 0 <= sy < height and 0 <= sx < width:
                        for c in range(channels):
                            total += float(image[c, sy, sx]) * weight[:, c, ky, kx].astype(np.float64)
            out[:, y, x] = total
    return out


def convolve_up(image, weight, bias):
    """Transposed 5x5 convolution of (C, H, W) to double size: stride 2, padding 2, output padding 1; float64.

    Input pixel (y, x) adds ``weight[c, :, ky, kx]`` times its value to output pixel (2y + ky - 2, 2x + kx - 2).
    """
    channels, height, width = image.shape
    outputs = weight.shape[1]
    out = np.empty((outputs, 2 * height, 2 * width))
    out[:] = np.array(bias, np.float64)[:, None, None]
    for y in range(height):
        for x in range(width):
            for ky in range(5):
                for kx in range(5):
                    ty, tx = 2 * y + ky - 2, 2 * x + kx - 2
                    if 0 <= ty < 2 * height and 0 <= tx < 2 * width:
                        for c in range(channels):
                            out[:, ty, tx] += float(image[c, y, x]) * weight[c, :, ky, kx].astype(np.float64)
    return out


def leaky(values, slope=0.1):
    """Leaky rectifier."""
    return np.where(values > 0, values, slope * values)


def phases_to_pixels(phases):
    """Lay out four phases, (4, h, w), as one plane: phase 2i + j is row 2y + i, column 2x + j."""
    _, height, width = phases.shape
    out = np.empty((2 * height, 2 * width), phases.dtype)
    for y in range(2 * height):
        for x in range(2 * width):
            out[y, x] = phases[2 * (y % 2) + x % 2, y // 2, x // 2]
    return out


def mixture(values, logits, residual, offsets, others):
    """Full-size map in which each pixel is a softmax-weighted mean of half-size values around it, plus a residual.

    `values` is (h, w); `others` (n, h, w) are values of the pixel itself that come after those at the offsets; `logits`
    (number of values, 4, h, w), the second axis the phase; `residual` (4, h, w). Neighbours beyond the border are the
    nearest pixel of the border.
    """
    height, width = values.shape
    out = np.empty((2 * height, 2 * width))
    for row in range(2 * height):
        for column in range(2 * width):
            y, x, phase = row // 2, column // 2, 2 * (row % 2) + column % 2
            highest = max(float(v) for v in logits[:, phase, y, x])
            shares = [math.exp(float(v) - highest) for v in logits[:, phase, y, x]]
            total = 0.0
            for share, (dy, dx) in zip(shares, offsets, strict=False):
                total += share * float(values[min(max(y + dy, 0), height - 1), min(max(x + dx, 0), width - 1)])
            for share, other in zip(shares[len(offsets) :], others, strict=True):
                total += share * float(other[y, x])
            out[row, column] = total / sum(shares) + float(residual[phase, y, x])
    return out


def divergence(mean, deviation, steps=20_000):
    """Kullback-Leibler divergence of N(mean, deviation) from N(0, 1), integrated from its definition."""
    total, width = 0.0, 24 * deviation / steps
    for k in range(steps):
        x = mean - 12 * deviation + (k + 0.5) * width
        log_p = -0.5 * ((x - mean) / deviation) ** 2 - math.log(deviation)
        log_q = -0.5 * x * x
        total += math.exp(log_p) / math.sqrt(2 * math.pi) * (log_p - log_q) * width
    return total


def outliers(estimate, truth):
    """Count of bad pixels and of known ones (truth above 0): off by more than 3 pixels and more than 5 %."""
    bad = known = 0
    for y in range(truth.shape[0]):
        for x in range(truth.shape[1]):
            true = float(truth[y, x])
            if true > 0:
                known += 1
                error = abs(float(estimate[y, x]) - true)
                bad += error > 3 and error / true > 0.05
    return bad, known
