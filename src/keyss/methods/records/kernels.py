"""Records of Gaussians, compiled: the numbers of a Gaussian as codes of a few bits, and back.

A *number* is what one code stands for, in the order of records: x, y, z, three log scales, opacity logit,
then of each band of harmonics the brightness of all coefficients and the two differences of all. `line_of`
[M] says on which line each number lies; `lines` [L, 3] are centre, spread and reach of these (see
`lines.Line`), and `far` [L] the reach of outliers.

The kernels may use nothing else of other files: they would outlive their change, see `rendering.cpu.jit`.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc,operator,assignment"

from __future__ import annotations

import math

import numpy as np

from keyss.rendering.cpu.jit import exact_inlined, exact_kernel

GEOMETRY = 7  # numbers before the harmonics
_LEAST_LENGTH = 0.5  # of a quaternion that was put together


@exact_inlined
def _clamped(value, limit):
    return np.float64(min(max(value, -limit), limit))


@exact_inlined
def _numbers(row, means, scales, opacities, sh, overflow, limits, opponent, numbers):
    """Fill `numbers` [M] with those of one Gaussian, all within `limits` [4] as single precision has them."""
    for i in range(3):
        numbers[i] = _clamped(means[row, i], limits[0])
        numbers[3 + i] = _clamped(scales[row, i], limits[1])
    numbers[6] = np.float64(-limits[2]) if overflow[row] else _clamped(opacities[row], limits[2])
    at, first, count = GEOMETRY, 0, 1
    while first < sh.shape[1]:
        for i in range(count):
            red = _clamped(sh[row, first + i, 0], limits[3])
            green = _clamped(sh[row, first + i, 1], limits[3])
            blue = _clamped(sh[row, first + i, 2], limits[3])
            numbers[at + i] = red * opponent[0, 0] + green * opponent[0, 1] + blue * opponent[0, 2]
            for j in range(1, 3):
                where = at + count + 2 * i + j - 1
                numbers[where] = red * opponent[j, 0] + green * opponent[j, 1] + blue * opponent[j, 2]
        at += 3 * count
        first += count
        count += 2


@exact_kernel
def overflow(start, stop, means, scales, quats, sh, limits, out):
    """`out` [N]: `core.Gaussians.overflow`; `limits` [4]: of a coordinate, log scale, length and colour."""
    for row in range(start, stop):
        fine, length = True, 0.0
        for i in range(3):
            fine &= abs(means[row, i]) <= limits[0] and scales[row, i] <= limits[1]
        for i in range(4):
            length += np.float64(quats[row, i]) * np.float64(quats[row, i])
        fine &= math.sqrt(length) <= limits[2]
        for i in range(sh.shape[1]):
            for j in range(3):
                fine &= abs(sh[row, i, j]) < limits[3]
        out[row] = not fine


@exact_kernel
def numbers_of(start, stop, means, scales, opacities, sh, overflow, limits, opponent, chosen, out):
    """`out` [C, N]: the `chosen` [C] numbers of every Gaussian."""
    numbers = np.empty(GEOMETRY + 3 * sh.shape[1])
    for row in range(start, stop):
        _numbers(row, means, scales, opacities, sh, overflow, limits, opponent, numbers)
        for i in range(len(chosen)):
            out[i, row] = numbers[chosen[i]]


@exact_kernel
def beyond(start, stop, means, scales, opacities, sh, overflow, limits, opponent, least, largest, out):
    """`out` [N]: which Gaussians have a number below its `least` [M] or above its `largest` [M] one."""
    numbers = np.empty(len(least))
    for row in range(start, stop):
        _numbers(row, means, scales, opacities, sh, overflow, limits, opponent, numbers)
        found = False
        for i in range(len(least)):
            found |= (numbers[i] < least[i]) | (numbers[i] > largest[i])
        out[row] = found


@exact_kernel
def reaches(
    start, stop, means, scales, opacities, sh, overflow, limits, opponent, line_of, centres, outlier, found
):
    """`found` [L, 5]: least and largest number of each line, sum of the distances from its centre [L], all
    without outliers; least and largest number of these.
    """
    numbers = np.empty(len(line_of))
    ends = np.empty((4, len(line_of)))  # of each number, which is faster than of each line
    ends[0], ends[1], ends[2], ends[3] = np.inf, -np.inf, np.inf, -np.inf
    found[:, 2] = 0.0
    for row in range(start, stop):
        _numbers(row, means, scales, opacities, sh, overflow, limits, opponent, numbers)
        least, largest = (ends[2], ends[3]) if outlier[row] else (ends[0], ends[1])
        for i in range(len(line_of)):
            least[i] = min(least[i], numbers[i])
            largest[i] = max(largest[i], numbers[i])
        if outlier[row]:
            continue
        first = 0
        while first < len(line_of):  # the numbers of a line are neighbours, mostly
            line, i = line_of[first], first
            total = found[line, 2]
            while i < len(line_of) and line_of[i] == line:
                total += abs(numbers[i] - centres[line])
                i += 1
            found[line, 2], first = total, i
    found[:, 0], found[:, 1], found[:, 3], found[:, 4] = np.inf, -np.inf, np.inf, -np.inf
    for i in range(len(line_of)):
        line = line_of[i]
        found[line, 0], found[line, 1] = min(found[line, 0], ends[0, i]), max(found[line, 1], ends[1, i])
        found[line, 3], found[line, 4] = min(found[line, 3], ends[2, i]), max(found[line, 4], ends[3, i])


@exact_inlined
def _code(value, centre, spread, reach, bits):
    """See `lines.Line.encode`."""
    offset = value - centre
    if spread > 0:
        scaled = abs(offset) / spread
        offset = math.copysign(math.log(scaled + math.sqrt(scaled * scaled + 1)), offset)
    last = np.float64((1 << bits) - 1)
    return np.uint64(min(max(np.rint((offset / reach + 1) * (last / 2)), 0.0), last))


@exact_kernel
def encode(
    start, stop, means, scales, quats, opacities, sh, overflow, limits, opponent, line_of, lines, far,
    outlier, bits_of, quat_bits, quat_reach, least_length, records,
):  # fmt: skip
    """`records` [N, bytes]: all codes of a Gaussian, one after the other; see docs/format.md."""
    numbers, unit = np.empty(len(line_of)), np.empty(4)
    for row in range(start, stop):
        length = 0.0
        for i in range(4):
            unit[i] = np.float64(quats[row, i])
            length += unit[i] * unit[i]
        length = math.sqrt(length)
        if not length > least_length:
            unit[0], unit[1], unit[2], unit[3], length = 1.0, 0.0, 0.0, 0.0, 1.0
        largest = 0
        for i in range(4):
            unit[i] /= length
            if abs(unit[i]) > abs(unit[largest]):
                largest = i
        sign = -1.0 if unit[largest] < 0 else 1.0

        kept, held, at = np.uint64(outlier[row]) << np.uint64(2) | np.uint64(largest), 3, 0
        for i in range(4):
            if i != largest:
                kept = kept << np.uint64(quat_bits) | _code(unit[i] * sign, 0.0, 0.0, quat_reach, quat_bits)
                held += quat_bits
                while held >= 8:
                    held -= 8
                    records[row, at] = kept >> np.uint64(held) & np.uint64(255)
                    at += 1
        _numbers(row, means, scales, opacities, sh, overflow, limits, opponent, numbers)
        for i in range(len(line_of)):
            line = line_of[i]
            reach = far[line] if outlier[row] else lines[line, 2]
            code = _code(numbers[i], lines[line, 0], lines[line, 1], reach, bits_of[line])
            kept = kept << np.uint64(bits_of[line]) | code
            held += bits_of[line]
            while held >= 8:
                held -= 8
                records[row, at] = kept >> np.uint64(held) & np.uint64(255)
                at += 1
        if held > 0:
            records[row, at] = kept << np.uint64(8 - held) & np.uint64(255)


@exact_inlined
def _read(record, at, bits):
    """The number of `bits` from bit `at` on."""
    code, first = np.uint64(0), at >> 3
    for i in range(first, (at + bits + 7) >> 3):
        code = code << np.uint64(8) | np.uint64(record[i])
    behind = np.uint64(-(at + bits) & 7)
    return code >> behind & np.uint64((1 << bits) - 1)


@exact_inlined
def _value(code, centre, spread, reach, bits):
    """See `lines.Line.decode`."""
    position = (np.float64(code) * (2 / np.float64((1 << bits) - 1)) - 1) * reach
    if spread > 0:
        position = math.sinh(position) * spread
    return position + centre


@exact_kernel
def decode(
    start, stop, records, line_of, lines, far, tables, begins, bits_of, quat_bits, quat_reach, opponent,
    means, scales, quats, opacities, sh,
):  # fmt: skip
    """Fill the tensors of the Gaussians in records [N, bytes].

    `tables`: one after the other what all codes of a line stand for, then those of outliers; `begins` [L]:
    where those of a line begin, -1 for lines that have too many codes for a table.
    """
    numbers, unit = np.empty(len(line_of)), np.empty(4)
    for row in range(start, stop):
        record = records[row]
        outlier, largest = record[0] > 127, np.int64(record[0] >> 5 & 3)
        at, squares = 3, 0.0
        for i in range(4):
            if i != largest:
                unit[i] = _value(_read(record, at, quat_bits), 0.0, 0.0, quat_reach, quat_bits)
                squares += unit[i] * unit[i]
                at += quat_bits
        unit[largest] = math.sqrt(max(1 - squares, 0.0))
        length = 0.0
        for i in range(4):
            length += unit[i] * unit[i]
        length = max(math.sqrt(length), _LEAST_LENGTH)
        for i in range(4):
            quats[row, i] = unit[i] / length

        for i in range(len(line_of)):
            line = line_of[i]
            bits = bits_of[line]
            code = _read(record, at, bits)
            at += bits
            if begins[line] >= 0:
                numbers[i] = tables[begins[line] + (np.int64(outlier) << bits) + np.int64(code)]
            else:
                reach = far[line] if outlier else lines[line, 2]
                numbers[i] = _value(code, lines[line, 0], lines[line, 1], reach, bits)
        for i in range(3):
            means[row, i] = numbers[i]
            scales[row, i] = numbers[3 + i]
        opacities[row] = numbers[6]
        at, first, count = GEOMETRY, 0, 1
        while first < sh.shape[1]:
            for i in range(count):
                bright = numbers[at + i]
                one, other = numbers[at + count + 2 * i], numbers[at + count + 2 * i + 1]
                for j in range(3):
                    colour = bright * opponent[0, j] + one * opponent[1, j] + other * opponent[2, j]
                    sh[row, first + i, j] = colour
            at += 3 * count
            first += count
            count += 2
