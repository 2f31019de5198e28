"""`stereokit.kernels.simd` in numpy, for kernels that Python runs: same names, same results, and checked accesses.

A vector is a `Lanes`. A load or store outside of its array raises `OutOfBounds`; an array of `aligned` is full of
garbage, so that values that nobody wrote spoil the result.
"""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["Lanes", "Misaligned", "OutOfBounds"]

LANES = 64
PART = 16


class OutOfBounds(Exception):
    """An access outside of its array."""


class Misaligned(Exception):
    """A streamed vector that does not begin at a multiple of 64 bytes."""


class Lanes:
    """Values of one type, 64 or the 16 of a part."""

    __slots__ = ("values",)

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    @property
    def scalar(self) -> Any:
        """The type of a lane in numba."""
        from numba import from_dtype

        return from_dtype(self.values.dtype)


def _part(array: np.ndarray, offset: Any, count: int = LANES) -> np.ndarray:
    if array.ndim != 1 or not 0 <= offset <= array.size - count:
        raise OutOfBounds(f"elements {offset} to {offset + count} of {array.size}")
    return array[offset : offset + count]


def load(array: np.ndarray, offset: Any) -> Lanes:
    return Lanes(_part(array, offset).copy())


def load_part(array: np.ndarray, offset: Any) -> Lanes:
    return Lanes(_part(array, offset, PART).copy())


def store(array: np.ndarray, offset: Any, value: Lanes) -> None:
    if array.dtype != value.values.dtype:
        raise TypeError(f"{value.values.dtype} into {array.dtype}")
    _part(array, offset, value.values.size)[:] = value.values


def store_pair(array: np.ndarray, start: Any, count: Any, k: Any, first: Any, second: Any) -> None:
    _part(_part(array, start, count), k, 1)[0] = (int(first) & 0xFFFF) | (int(second) << 16)


def load_pairs(array: np.ndarray, start: Any, count: Any, k: Any) -> Lanes:
    return load_part(_part(array, start, count), k)


def stream(array: np.ndarray, offset: Any, value: Lanes) -> None:
    if _part(array, offset).ctypes.data % 64:
        raise Misaligned(f"element {offset}")
    store(array, offset, value)


def prefetch(array: np.ndarray, offset: Any) -> None:
    pass


def stream_fence() -> None:
    pass


def splat(scalar: Any) -> Lanes:
    return Lanes(np.full(LANES, scalar, np.asarray(scalar).dtype))


def splat_at(array: np.ndarray, offset: Any) -> Lanes:
    return splat(_part(array, offset, 1)[0])


def splat_part(scalar: Any) -> Lanes:
    return Lanes(np.full(PART, scalar, np.asarray(scalar).dtype))


def splat_part_at(array: np.ndarray, offset: Any) -> Lanes:
    return splat_part(_part(array, offset, 1)[0])


splat_pair_at = splat_part_at


def splat_parts(scalar: Any) -> tuple[Lanes, ...]:
    return (splat_part(scalar),) * (LANES // PART)


def each_part(step: Any, parts: tuple[Lanes, ...], lane: int, context: Any) -> tuple[Any, ...]:
    return tuple(step(part, lane + k * PART, context) for k, part in enumerate(parts))


def aligned(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    raw = np.random.default_rng(size).integers(0, 256, size + 64, np.uint8)
    start = -raw.ctypes.data % 64
    array = raw[start : start + size].view(dtype).reshape(shape)
    if array.dtype.kind == "f":
        array[:] = np.nan
    return array


def add(a: Lanes, b: Lanes) -> Lanes:
    return Lanes(a.values + b.values)


def subtract(a: Lanes, b: Lanes) -> Lanes:
    return Lanes(a.values - b.values)


def multiply(a: Lanes, b: Lanes) -> Lanes:
    return Lanes(a.values * b.values)


def multiply_high_doubled(a: Lanes, b: Lanes) -> Lanes:
    return Lanes((a.values.astype(np.int32) * b.values >> 15).astype(np.int16))


def add_saturated(a: Lanes, b: Lanes) -> Lanes:
    info = np.iinfo(a.values.dtype)
    return Lanes(np.clip(a.values.astype(np.int64) + b.values, info.min, info.max).astype(a.values.dtype))


def minimum(a: Lanes, b: Lanes) -> Lanes:
    return Lanes(np.where(a.values < b.values, a.values, b.values))


def maximum(a: Lanes, b: Lanes) -> Lanes:
    return Lanes(np.where(a.values > b.values, a.values, b.values))


def xor(a: Lanes, b: Lanes) -> Lanes:
    return Lanes(a.values ^ b.values)


def bitwise_or(a: Lanes, b: Lanes) -> Lanes:
    return Lanes(a.values | b.values)


def mark_less(a: Lanes, b: Lanes, bit: Any) -> Lanes:
    return Lanes(np.where(a.values < b.values, np.uint8(bit), np.uint8(0)))


def count_bits(value: Lanes) -> Lanes:
    size = value.values.dtype.itemsize
    bits = np.unpackbits(value.values.view(np.uint8).reshape(LANES, size), axis=1)
    return Lanes(bits.sum(axis=1).astype(value.values.dtype))


def count_ones(value: Any) -> Any:
    return np.int32(bin(int(value)).count("1"))


def convert(value: Lanes, like: Any) -> Lanes:
    return Lanes(value.values.astype(np.asarray(like).dtype))


def bits_of(value: Lanes) -> Lanes:
    return Lanes(value.values.view(np.int32))


def add_pairs(total: Lanes, pairs: Lanes, factors: Lanes) -> Lanes:
    low = [v.values << 16 >> 16 for v in (pairs, factors)]
    high = [v.values >> 16 for v in (pairs, factors)]
    return Lanes(total.values + low[0] * low[1] + high[0] * high[1])


def add_firsts(total: Lanes, pairs: Lanes, factors: Lanes) -> Lanes:
    assert (factors.values >> 16 == 0).all()
    return add_pairs(total, pairs, factors)


def add_scaled(total: Lanes, a: Lanes, b: Lanes) -> Lanes:
    return Lanes(total.values + a.values * (b.values << 16 >> 16))


def shift_left(value: Lanes, count: Any) -> Lanes:
    return Lanes(value.values << value.values.dtype.type(count))


def shift_right(value: Lanes, count: Any) -> Lanes:
    return Lanes(value.values >> value.values.dtype.type(count))


def shift_up(a: Lanes, b: Lanes) -> Lanes:
    return Lanes(np.append(a.values[-1:], b.values[:-1]))


def shift_down(a: Lanes, b: Lanes) -> Lanes:
    return Lanes(np.append(a.values[1:], b.values[:1]))


def lowest(value: Lanes) -> Any:
    return value.values.min()


def lowest_of_4(a: Lanes, b: Lanes, c: Lanes, d: Lanes) -> tuple[Lanes, ...]:
    return tuple(splat(v.values.min()) for v in (a, b, c, d))


def first_lane(value: Lanes) -> Any:
    return value.values[0]


def mask_equal(a: Lanes, b: Lanes) -> int:
    return sum(1 << k for k in np.flatnonzero(a.values == b.values).tolist())


def first_bit(mask: int) -> int:
    mask = int(mask)
    return (mask & -mask).bit_length() - 1 if mask else LANES


def without_three(value: Lanes, first: int) -> Lanes:
    values = value.values.copy()
    values[max(first, 0) : max(first + 3, 0)] = np.iinfo(values.dtype).max
    return Lanes(values)


def select(condition: Any, a: Any, b: Any) -> Any:
    return a if condition else b
