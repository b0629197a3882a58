"""What is done with the words of every Gaussian, compiled: low bits, and what gives a Gaussian away.

All functions take four arrays of bit patterns (uint32, see `bits.words_of`): log scales [N, 3], quaternions
[N, 4], opacity logits [N] and harmonics [N, 3 K], and work on the rows `start` to `stop`. The *fields* of a
Gaussian are its log scales, quaternion, opacity and harmonics above the constant ones: F numbers, for which
`mask` [F] has the bits in use.

The kernels may use nothing else of other files: they would outlive their change, see `rendering.cpu.jit`.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc,operator,assignment"

from __future__ import annotations

import numpy as np

from keyss.rendering.cpu.jit import exact_inlined, exact_kernel

GEOMETRY = 8  # fields before the harmonics
MOST_ZEROS, EXPONENTS = 12, 256
# [4096] the zero bits at the end of a number of MOST_ZEROS bits.
_TRAILING = np.array(
    [min((i & -i).bit_length() - 1, MOST_ZEROS) if i else MOST_ZEROS for i in range(4096)], np.uint8
)
_ABSOLUTE = np.uint32(0x7FFFFFFF)
_MANTISSA = np.uint32((1 << 23) - 1)
_ONE, _EXPONENT = np.uint32(1), np.uint32(255)
_HASH, _HASH_SHIFT = np.uint64(0x9E3779B97F4A7C15), np.uint64(29)


@exact_inlined
def _fields(scales, quats, opacities, sh, row, used):
    """Fill `used` [F] with the fields of one Gaussian."""
    for i in range(3):
        used[i] = scales[row, i]
    for i in range(4):
        used[3 + i] = quats[row, i]
    used[7] = opacities[row]
    for i in range(3, sh.shape[1]):
        used[5 + i] = sh[row, i]


@exact_kernel
def pack(start, stop, scales, quats, opacities, sh, with_quats, out):
    """`out` [N, B] uint8: the low bits; 8 of each field before the harmonics, 12 of each harmonic."""
    used = np.empty(5 + sh.shape[1], np.uint32)
    width = out.shape[1]
    for row in range(start, stop):
        _fields(scales, quats, opacities, sh, row, used)
        at = 0
        for i in range(GEOMETRY):
            if with_quats or i < 3 or i == 7:
                out[row, at] = used[i] >> 1 & 255
                at += 1
        for i in range(GEOMETRY, len(used), 2):
            first = used[i] >> 1 & 4095
            second = used[i + 1] >> 1 & 4095 if i + 1 < len(used) else np.uint32(0)
            out[row, at] = first >> 4
            if at + 2 < width:
                out[row, at + 1] = (first & 15) << 4 | second >> 8
                out[row, at + 2] = second & 255
            at += 3


@exact_kernel
def unpack(start, stop, chosen, data, scales, quats, opacities, sh, with_quats):
    """Replace the low bits of Gaussians by the `chosen` [N] rows of `data` [R, B]; of those with -1 none.

    Where a Gaussian's bits are no whole number of bytes, the last half byte stays as it is.
    """
    used = np.empty(5 + sh.shape[1], np.uint32)
    width = data.shape[1]
    for row in range(start, stop):
        index, at = chosen[row], 0
        if index < 0:
            continue
        _fields(scales, quats, opacities, sh, row, used)
        for i in range(GEOMETRY):
            if with_quats or i < 3 or i == 7:
                used[i] = used[i] & ~np.uint32(255 << 1) | np.uint32(data[index, at]) << _ONE
                at += 1
        for i in range(GEOMETRY, len(used), 2):
            a = np.uint32(data[index, at])
            if at + 2 < width:
                b, c = np.uint32(data[index, at + 1]), np.uint32(data[index, at + 2])
                used[i] = used[i] & ~np.uint32(4095 << 1) | (a << np.uint32(4) | b >> np.uint32(4)) << _ONE
                low = (b & np.uint32(15)) << np.uint32(8) | c
                used[i + 1] = used[i + 1] & ~np.uint32(4095 << 1) | low << _ONE
            else:
                used[i] = used[i] & ~np.uint32(255 << 5) | a << np.uint32(5)
            at += 3
        for i in range(3):
            scales[row, i] = used[i]
        for i in range(4):
            quats[row, i] = used[3 + i]
        opacities[row] = used[7]
        for i in range(3, sh.shape[1]):
            sh[row, i] = used[5 + i]


@exact_inlined
def _coarse_length(used, middle, floats):
    """Of the quaternion among the fields, with the middle of all low bits that it could have; double."""
    for i in range(4):
        middle[i] = used[3 + i] & ~np.uint32(511) | np.uint32(256)
    total = 0.0
    for i in range(4):
        total += np.float64(floats[i]) * np.float64(floats[i])
    return np.sqrt(total)


@exact_inlined
def _near_equal(used, shifts, with_quats, high):
    """Whether two numbers are nearly equal that should not be; see `usable.near_equal`."""
    fields = len(used)
    for i in range(fields):
        high[i] = np.int32((used[i] & _ABSOLUTE) >> shifts[i])
    for a in range(2):
        for b in range(a + 1, 3):
            if abs(high[a] - high[b]) <= 1:
                return True
    if with_quats:
        for a in range(3, 6):
            for b in range(a + 1, 7):
                if abs(high[a] - high[b]) <= 1:
                    return True
    for i in range(GEOMETRY, fields, 3):
        red, green, blue = high[i], high[i + 1], high[i + 2]
        if abs(red - green) <= 1 or abs(red - blue) <= 1 or abs(green - blue) <= 1:
            return True
    # Where two numbers are equal to the next in ascending order there are two pairs of equal ones, or three.
    pairs = 0
    for apart in range(3, fields - GEOMETRY, 3):
        one, other = high[GEOMETRY : fields - apart], high[GEOMETRY + apart :]
        for i in range(len(one)):
            pairs += one[i] == other[i]
    return pairs >= 2


@exact_kernel
def ranks(
    start, stop, scales, quats, opacities, sh, mask, shifts, with_quats, unit_tolerance, coincidences, out
):  # fmt: skip
    """`out` [N] uint64: 256 for what may well be left alone, and less the larger the least harmonic is.

    Without `coincidences` what nearly equal numbers tell is left out.
    """
    fields = len(mask)
    used, high = np.empty(fields, np.uint32), np.empty(fields, np.int32)
    middle = np.empty(4, np.uint32)
    floats = middle.view(np.float32)
    for row in range(start, stop):
        _fields(scales, quats, opacities, sh, row, used)
        doubtful = coincidences and _near_equal(used, shifts, with_quats, high)
        least = _EXPONENT
        for i in range(fields):
            if i < 3 or i > 6 or with_quats:
                exponent = used[i] >> np.uint32(23) & _EXPONENT
                if i >= GEOMETRY or fields == GEOMETRY:
                    least = min(least, exponent)
                if exponent == 0 or used[i] & _MANTISSA & ~mask[i] & ~_ONE == 0:
                    doubtful = True
        if with_quats and abs(_coarse_length(used, middle, floats) - 1) < unit_tolerance:
            doubtful = True
        out[row] = np.uint64(256 if doubtful else 0) | np.uint64(_EXPONENT - least)


@exact_kernel
def tally(start, stop, values, first, shift, times):
    """Add to `times` [P] uint8 how many of the `values` [N, C] from column `first` on fall to each place.

    A place is the upper bits of a product, `shift` fewer than 64. 255 means so many or more.
    """
    for row in range(start, stop):
        for column in range(first, values.shape[1]):
            place = np.uint64(values[row, column]) * _HASH >> shift
            before = times[place]
            times[place] = before + np.uint8(before < 255)


@exact_kernel
def crowded(start, stop, values, first, shift, places, out):
    """Put values on one of the `places`, which are bits of bytes, in `out`; returns how many."""
    found = 0
    for row in range(start, stop):
        for column in range(first, values.shape[1]):
            place = np.uint64(values[row, column]) * _HASH >> shift
            out[found] = values[row, column]
            found += np.int64(places[place >> np.uint64(3)] >> (place & np.uint64(7)) & np.uint64(1))
    return found


@exact_kernel
def meet(values, shift, seen, twice):
    """Put the rows of those `values` [N] that fall on places in `twice` in `rows`; returns how many."""
    for value in values:
        place = value * _HASH >> shift
        word, bit = place >> np.uint64(6), np.uint64(1) << (place & np.uint64(63))
        twice[word] |= seen[word] & bit
        seen[word] |= bit


@exact_kernel
def met(values, shift, twice, rows):
    """Put the rows of those of the `values` [N] that fall on places in `twice` in `rows`; the count."""
    found = 0
    for row in range(len(values)):
        place = values[row] * _HASH >> shift
        rows[found] = row
        found += np.int64(twice[place >> np.uint64(6)] >> (place & np.uint64(63)) & np.uint64(1))
    return found


@exact_kernel
def order(numbers, rows):
    """`rows` [N]: what sorts uniformly random `numbers` [N] of 64 bits; equal ones by row."""
    bits = 0
    while 2 << bits <= len(numbers):
        bits += 1
    shift = np.uint64(63 - bits)  # twice as many places as numbers, at most
    ends = np.zeros((2 << bits) + 1, np.int64)
    for number in numbers:
        ends[(number >> shift) + np.uint64(1)] += 1
    for place in range(1, len(ends)):
        ends[place] += ends[place - 1]
    ordered = np.empty(len(numbers), np.uint64)
    for row in range(len(numbers)):
        number = numbers[row]
        place = number >> shift
        ordered[ends[place]], rows[ends[place]] = number, row
        ends[place] += 1
    for last in range(1, len(numbers)):  # those on one place
        number, row, at = ordered[last], rows[last], last
        while at > 0 and ordered[at - 1] > number:
            ordered[at], rows[at] = ordered[at - 1], rows[at - 1]
            at -= 1
        ordered[at], rows[at] = number, row


@exact_kernel
def triples(start, stop, scales, quats, opacities, sh, mask, with_quats, out):
    """`out` [T, N] uint64: hashes of what stays of the scales, the quaternion, and harmonics in pairs.

    Those with numbers 1 and 2, 3 and 4 and so on, of all colours. Returns how many of the numbers in use are
    short: normal ones of which the 20 low bits are zero.
    """
    fields = len(mask)
    used = np.empty(fields, np.uint32)
    short = 0
    for row in range(start, stop):
        _fields(scales, quats, opacities, sh, row, used)
        for i in range(fields):
            if i < 3 or i > 6 or with_quats:
                short += (used[i] & np.uint32(0xFFFFF)) == 0 and used[i] >> np.uint32(23) & _EXPONENT != 0
        for key in range(out.shape[0]):
            if key == 0:
                begin, end = 0, 3
            elif with_quats and key == 1:
                begin, end = 3, 7
            else:
                begin = GEOMETRY + 6 * (key - 2 if with_quats else key - 1)
                end = begin + 6
            state = np.uint64(0)
            for i in range(begin, end):
                state = (state ^ np.uint64(used[i] & ~mask[i] & ~_ONE)) * _HASH
                state ^= state >> _HASH_SHIFT
            out[key, row] = state
    return short


@exact_inlined
def _is_among(value, ascending, begin, end):
    """Whether `value` is among `ascending` from `begin` to `end`."""
    while begin < end:
        half = (begin + end) // 2
        if ascending[half] < value:
            begin = half + 1
        else:
            end = half
    return begin < len(ascending) and ascending[begin] == value


@exact_kernel
def judge(
    start, stop, scales, quats, opacities, sh, mask, shifts, groups, with_quats, short, frequent, ends,
    zero_fields, unit_tolerance, exact, usable, counts,
):  # fmt: skip
    """Clear `usable` [N] for what is no measurement or a coincidence, and count the zeros of what is left.

    `groups` [F]: the group of each field. `frequent`: of each group the values that occur too often, in
    ascending order one group after the other, with their `ends` [G + 1]. `counts` [G, EXPONENTS, MOST_ZEROS +
    1]: by exponent and trailing zeros.
    """
    fields = len(mask)
    used, high = np.empty(fields, np.uint32), np.empty(fields, np.int32)
    middle = np.empty(4, np.uint32)
    floats = middle.view(np.float32)
    for row in range(start, stop):
        if not usable[row]:
            continue
        _fields(scales, quats, opacities, sh, row, used)
        fine, zeros = True, 0
        for i in range(fields):
            if i < 3 or i > 6 or with_quats:
                exponent = used[i] >> np.uint32(23) & _EXPONENT
                fine &= exponent > 0 and exponent < 254
                if short:
                    fine &= (used[i] & np.uint32(0xFFFFF)) != 0
                zeros += (used[i] & np.uint32(0xFFF)) == 0
                group = groups[i]
                if ends[group] < ends[group + 1]:
                    fine &= not _is_among(used[i], frequent[: ends[group + 1]], ends[group], ends[group + 1])
        fine &= zeros < zero_fields
        if fine:
            fine = not _near_equal(used, shifts, with_quats, high)
        if fine and with_quats and abs(_coarse_length(used, middle, floats) - 1) < unit_tolerance:
            for i in range(4):
                middle[i] = used[3 + i]
            total = 0.0
            for i in range(4):
                total += np.float64(floats[i]) * np.float64(floats[i])
            fine = not abs(np.sqrt(total) - 1) < exact
        usable[row] = fine
        if fine:
            for i in range(fields):
                exponent = used[i] >> np.uint32(23) & _EXPONENT
                counts[groups[i], exponent, _TRAILING[used[i] & np.uint32(0xFFF)]] += 1


@exact_kernel
def leave_small(start, stop, scales, quats, opacities, sh, groups, with_quats, least, usable):
    """Clear `usable` [N] where an even number has an exponent below the `least` [G] of its group."""
    used = np.empty(5 + sh.shape[1], np.uint32)
    for row in range(start, stop):
        if not usable[row]:
            continue
        _fields(scales, quats, opacities, sh, row, used)
        fine = True
        for i in range(len(used)):
            if i < 3 or i > 6 or with_quats:
                small = np.int64(used[i] >> np.uint32(23) & _EXPONENT) < least[groups[i]]
                fine &= not (small and used[i] & _ONE == 0)
        usable[row] = fine
