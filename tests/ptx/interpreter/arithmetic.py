"""Results of the less simple instructions, on numpy arrays of lanes; PTX ISA chapter 9.7."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["FUNCTIONS"]

_SIGNED = {"u": "i", "i": "i"}


def fma(a: Any, b: Any, c: Any) -> Any:
    """Return ``a * b + c`` of float32 with one rounding.

    The product is exact in float64; the sum is rounded to odd there, after which rounding to float32 is right
    (Boldo and Melquiond 2008).
    """
    product = np.multiply(a, b, dtype=np.float64)
    total = product + c
    part = total - product
    error = (product - (total - part)) + (c - part)
    bits = np.ascontiguousarray(total).view(np.int64)
    fix = (error != 0) & np.isfinite(total) & ((bits & 1) == 0)
    if fix.any():
        step = np.where((error > 0) == (total > 0), 1, -1)
        total = np.where(fix, bits + step, bits).view(np.float64)
    return total.astype(np.float32)


def divide(a: Any, b: Any) -> Any:
    """Return the quotient of integers, rounded to zero; by zero, all bits."""
    safe = np.where(b == 0, b.dtype.type(1), b)
    quotient = a // safe
    if a.dtype.kind == "i":
        quotient = quotient + ((a % safe != 0) & ((a < 0) != (safe < 0)))
    return np.where(b == 0, a.dtype.type(-1) if a.dtype.kind == "i" else np.iinfo(a.dtype).max, quotient).astype(
        a.dtype
    )


def remainder(a: Any, b: Any) -> Any:
    """Return the remainder of integer division, with the sign of `a`."""
    return np.where(b == 0, a, a - divide(a, b) * b).astype(a.dtype)


def high(a: Any, b: Any) -> Any:
    """Return the upper half of a product of integers."""
    size = a.dtype.itemsize
    if size < 8:
        wide = f"{a.dtype.kind}{2 * size}"
        return (np.asarray(a).astype(wide) * np.asarray(b).astype(wide) >> (8 * size)).astype(a.dtype)
    products = [(int(p) * int(q)) >> 64 for p, q in np.broadcast(a, b)]
    return np.array([p & (2**64 - 1) for p in products], np.uint64).view(a.dtype)


def shift_left(a: Any, by: Any) -> Any:
    """Return bits shifted up; by the width or more, zero."""
    width = 8 * a.dtype.itemsize
    return np.where(by >= width, a.dtype.type(0), a << np.minimum(by, width - 1).astype(a.dtype))


def shift_right(a: Any, by: Any) -> Any:
    """Return bits shifted down; by the width or more, zero or the sign."""
    width = 8 * a.dtype.itemsize
    shifted = a >> np.minimum(by, width - 1).astype(a.dtype)
    return shifted if a.dtype.kind == "i" else np.where(by >= width, a.dtype.type(0), shifted)


def funnel(a: Any, b: Any, by: Any, left: bool, wrap: bool) -> Any:
    """Return 32 bits of the pair ``b:a`` shifted."""
    by = (by & np.uint32(31) if wrap else np.minimum(by, 32)).astype(np.uint64)
    pair = b.astype(np.uint64) << np.uint64(32) | a
    return (((pair << by) >> np.uint64(32)) if left else (pair >> by)).astype(np.uint32)


def insert_bits(a: Any, b: Any, position: Any, length: Any) -> Any:
    """Return `b` with `length` bits of `a` from `position` on."""
    kind, width = b.dtype, 8 * b.dtype.itemsize
    position, length = (np.asarray(v).astype(np.uint64) & np.uint64(255) for v in (position, length))
    ones = np.where(length >= 64, np.uint64(2**64 - 1), (np.uint64(1) << np.minimum(length, 63)) - np.uint64(1))
    inside = position < width
    position = np.minimum(position, np.uint64(63))
    mask = np.where(inside, ones << position, np.uint64(0))
    return ((b.astype(np.uint64) & ~mask) | ((np.asarray(a).astype(np.uint64) << position) & mask)).astype(kind)


def extract_bits(a: Any, position: Any, length: Any) -> Any:
    """Return `length` bits of `a` from `position` on, with sign for signed types."""
    kind, width = a.dtype, 8 * a.dtype.itemsize
    position, length = (np.asarray(v).astype(np.int64) & 255 for v in (position, length))
    length = np.minimum(length, width)
    if kind.kind == "i":
        whole = shift_right(a, np.minimum(position, width - 1))
        rest = np.minimum(width - length, width - 1).astype(kind)
        return np.where(length == 0, kind.type(0), (whole << rest) >> rest)
    whole = shift_right(a, position)
    ones = np.where(
        length >= width,
        kind.type(2**width - 1),
        (kind.type(1) << np.minimum(length, width - 1).astype(kind)) - kind.type(1),
    )
    return whole & ones


def permute(a: Any, b: Any, selector: Any) -> Any:
    """Return four bytes picked from eight."""
    size = np.broadcast(a, b, selector).shape
    both = np.broadcast_to(np.asarray(b).astype(np.uint64) << np.uint64(32) | a, size)
    out = np.zeros(size, np.uint32)
    for k in range(4):
        pick = (np.broadcast_to(selector, size) >> np.uint32(4 * k)) & np.uint32(15)
        byte = (both >> ((pick & np.uint32(7)).astype(np.uint64) * np.uint64(8))) & np.uint64(255)
        sign = np.where(byte & np.uint64(128), np.uint64(255), np.uint64(0))
        out |= np.where(pick & np.uint32(8), sign, byte).astype(np.uint32) << np.uint32(8 * k)
    return out


def logic3(a: Any, b: Any, c: Any, table: int) -> Any:
    """Return any function of three bits, by its truth table."""
    out = np.zeros(np.broadcast(a, b, c).shape, np.uint32)
    for k in range(8):
        if table >> k & 1:
            out |= (a if k & 4 else ~a) & (b if k & 2 else ~b) & (c if k & 1 else ~c)
    return out


def top_bit(a: Any) -> Any:
    """Return the place of the highest one bit, or -1 without any."""
    place = np.full(a.shape, -1, np.int32)
    for k in range(8 * a.dtype.itemsize):
        place[(a >> a.dtype.type(k)) & a.dtype.type(1) != 0] = k
    return place


def leading_zeros(a: Any) -> Any:
    """Return the number of leading zeros."""
    return (8 * a.dtype.itemsize - 1 - top_bit(a)).astype(np.uint32)


def find_bit(a: Any, as_shift: bool) -> Any:
    """Return the place of the highest bit that differs from the sign, or the shift that brings it to the top."""
    if a.dtype.kind == "i":
        a = np.where(a < 0, ~a, a).view(f"u{a.dtype.itemsize}")
    place = top_bit(a)
    if as_shift:
        place = np.where(place < 0, -1, 8 * a.dtype.itemsize - 1 - place).astype(np.int32)
    return place.view(np.uint32)


def reverse(a: Any) -> Any:
    """Return the bits in the opposite order."""
    out = np.zeros_like(a)
    for k in range(8 * a.dtype.itemsize):
        out |= ((a >> a.dtype.type(k)) & a.dtype.type(1)) << a.dtype.type(8 * a.dtype.itemsize - 1 - k)
    return out


def dot(a: Any, b: Any, c: Any, pairs: int, upper: bool) -> Any:
    """Return ``c`` plus a dot product: of four bytes, or of two halves of `a` and two bytes of `b`."""
    a, b = np.broadcast_arrays(a, b)
    step = 8 if pairs == 4 else 16
    total = np.asarray(c).astype(np.int64)
    for k in range(pairs):
        left = np.ascontiguousarray(a).view(f"{a.dtype.kind}{step // 8}").reshape(-1, pairs)[:, k]
        right = np.ascontiguousarray(b).view(f"{b.dtype.kind}1").reshape(-1, 4)[:, k + 2 * upper]
        total = total + left.astype(np.int64) * right.astype(np.int64)
    return total.astype(np.uint32)


def convert(value: Any, kind: str, rounding: str | None, saturate: bool) -> Any:
    """Return values in another type: a new array."""
    to = np.dtype(kind)
    if value.dtype.kind == "f" and rounding in ("rni", "rzi", "rmi", "rpi"):
        value = {"rni": np.rint, "rzi": np.trunc, "rmi": np.floor, "rpi": np.ceil}[rounding](value)
    if value.dtype.kind == "f" and to.kind in "iu":
        limits = np.iinfo(to)
        wide = value.astype(np.float64)
        inside = (wide > limits.min) & (wide < float(limits.max))
        whole = np.where(inside, wide, 0.0).astype(to)
        whole = np.where(wide >= float(limits.max), to.type(limits.max), whole)
        return np.where(wide <= limits.min, to.type(limits.min), whole)
    if saturate and to.kind in "iu":
        limits, have = np.iinfo(to), np.iinfo(value.dtype)
        value = np.clip(value, max(limits.min, have.min), min(limits.max, have.max))
    if saturate and to.kind == "f":
        value = np.clip(np.nan_to_num(value, nan=0.0), 0.0, 1.0)
    return value.astype(to)


def saturated(value: Any, kind: str) -> Any:
    """Return 64-bit integers clamped to the range of a type."""
    limits = np.iinfo(kind)
    return np.clip(value, limits.min, limits.max).astype(kind)


def unordered(a: Any, b: Any) -> Any:
    """Return whether either is NaN."""
    return np.isnan(a) | np.isnan(b)


FUNCTIONS = {
    function.__name__: function
    for function in (
        fma, divide, remainder, high, shift_left, shift_right, funnel, insert_bits, extract_bits, permute, logic3,
        leading_zeros, find_bit, reverse, dot, convert, saturated, unordered,
    )
}  # fmt: skip
"""By the names that translated kernels use."""
