"""CUDA twins of the preparation of images: grey, half size, Gaussian blur; and the ranges of values.

All are integers and equal `stereokit.images.gray`, `stereokit.images.resize` and `stereokit.images.blur` to the last
bit. OpenCV makes grey with 15-bit weights, rounds the mean of four pixels half up, and blurs 16-bit images with 16-bit
weights and one rounding at the end. The weights come from OpenCV itself: it blurs an impulse.

The two images of a pair lie behind one another in one array, ``(2, H, W)`` flat, so that each stage is one launch.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from stereokit.cuda.kernel import (
    Kernel,
    Queue,
    array,
    blocks_for,
    cuda,
    device,
    f32,
    i32,
    kernel,
    shuffle_xor,
    u8,
    u16,
    u32,
    u64,
)
from stereokit.images.blur import gaussian_weights

__all__ = [
    "KINDS",
    "clamped",
    "flip",
    "halve",
    "ranges",
    "smooth",
    "take",
    "take_kernel",
]

KINDS = {np.dtype(np.uint8): u8, np.dtype(np.uint16): u16}

_PARTS = 32
"""Blocks that search one image for its range: as many as a warp has lanes."""


@device
def clamped(value, last):  # type: ignore[no-untyped-def]
    """Return `value`, clamped to 0..`last`."""
    return i32(min(max(i32(value), i32(0)), i32(last)))


@cache
def take_kernel(dtype: np.dtype[Any]) -> Kernel:
    """Return the kernel that copies an image, grey or RGB, into its place, mirrored on request."""
    kind = KINDS[dtype]

    @kernel(array(kind), array(kind), i32, i32, i32, i32, i32, block=128, name=f"take_{dtype}")
    def take(image, out, place, channels, mirrored, height, width):  # type: ignore[no-untyped-def]
        index = u32(cuda.grid(1))
        pixels = u32(u32(height) * u32(width))
        if index < pixels:
            x = u32(index % u32(width))
            source = index
            if mirrored != 0:
                source = u32(u32(index - x) + u32(u32(width) - u32(1) - x))
            value = kind(0)
            if channels == 1:
                value = image[source]
            else:
                source = u32(source * u32(3))
                red = u32(u32(image[source]) * u32(9798))
                green = u32(u32(image[u32(source + u32(1))]) * u32(19235))
                blue = u32(u32(image[u32(source + u32(2))]) * u32(3735))
                value = kind(u32(red + green + blue + u32(16384)) >> u32(15))
            out[u32(u32(place) * pixels + index)] = value

    result: Kernel = take
    return result


@cache
def halve_kernel(dtype: np.dtype[Any]) -> Kernel:
    """Return the kernel that averages 2x2 pixels of `count` images."""
    kind = KINDS[dtype]

    @kernel(array(kind), array(kind), i32, i32, i32, i32, block=128, name=f"halve_{dtype}")
    def halve(images, out, count, height, width, largest):  # type: ignore[no-untyped-def]
        down = u32((u32(height) + u32(1)) >> u32(1))
        across = u32((u32(width) + u32(1)) >> u32(1))
        index = u32(cuda.grid(1))
        if index < u32(u32(count) * down * across):
            x = u32(index % across)
            row = u32(index // across)
            y = u32(row % down)
            base = u32(u32(row // down) * u32(height))
            y0 = u32(u32(base + u32(2) * y) * u32(width))
            y1 = u32(u32(base + min(u32(u32(2) * y + u32(1)), u32(u32(height) - u32(1)))) * u32(width))
            x0 = u32(u32(2) * x)
            x1 = min(u32(x0 + u32(1)), u32(u32(width) - u32(1)))
            a, b = u32(images[u32(y0 + x0)]), u32(images[u32(y0 + x1)])
            c, d = u32(images[u32(y1 + x0)]), u32(images[u32(y1 + x1)])
            mean = u32(u32(a + b + c + d + u32(2)) >> u32(2))
            out[index] = kind(max(max(a, b), max(c, d)) if largest != 0 else mean)

    result: Kernel = halve
    return result


@cache
def blur_rows_kernel(dtype: np.dtype[Any]) -> Kernel:
    """Return the kernel that blurs `rows` rows; 8-bit pixels count 256 times."""
    kind = KINDS[dtype]
    times = 256 if dtype == np.uint8 else 1

    @kernel(array(kind), array(u32), i32, array(u32), i32, i32, block=128, name=f"blur_rows_{dtype}")
    def blur_rows(images, weights, half, out, rows, width):  # type: ignore[no-untyped-def]
        index = u32(cuda.grid(1))
        if index < u32(u32(rows) * u32(width)):
            x = u32(index % u32(width))
            row = u32(index - x)
            total = u32(0)
            for k in range(2 * half + 1):
                column = clamped(i32(x) + i32(k) - half, width - 1)
                total = u32(total + u32(weights[u32(k)] * u32(images[u32(row + u32(column))])))
            out[index] = u32(total * u32(times))

    result: Kernel = blur_rows
    return result


@kernel(array(u32), array(u32), i32, array(u16), i32, i32, i32, block=128)
def blur_columns(rows, weights, half, out, count, height, width):  # type: ignore[no-untyped-def]
    """Blur the columns of `count` images whose rows were blurred."""
    index = u32(cuda.grid(1))
    if index < u32(u32(count) * u32(height) * u32(width)):
        x = u32(index % u32(width))
        row = u32(index // u32(width))
        y = u32(row % u32(height))
        base = u32(row - y)
        total = u64(1 << 31)
        for k in range(2 * half + 1):
            other = clamped(i32(y) + i32(k) - half, height - 1)
            total = u64(total + u64(weights[u32(k)]) * u64(rows[u32(u32(base + u32(other)) * u32(width) + x)]))
        out[index] = u16(total >> u64(32))


@cache
def ranges_kernel(dtype: np.dtype[Any]) -> Kernel:
    """Return the kernel that finds the smallest and the largest pixel of each of `_PARTS` parts of both images."""
    kind = KINDS[dtype]
    threads = 256

    @kernel(array(kind), array(i32), i32, block=threads, name=f"ranges_{dtype}")
    def ranges(images, out, pixels):  # type: ignore[no-untyped-def]
        lows = cuda.shared.array(8, i32)
        highs = cuda.shared.array(8, i32)
        thread = u32(cuda.threadIdx.x)
        block = u32(cuda.blockIdx.x)
        first = u32(u32(block // u32(_PARTS)) * u32(pixels))
        low, high = i32(65535), i32(0)
        index = u32(u32(u32(block % u32(_PARTS)) * u32(threads)) + thread)
        while index < u32(pixels):
            value = i32(images[u32(first + index)])
            low, high = min(low, value), max(high, value)
            index = u32(index + u32(threads * _PARTS))
        for mask in (16, 8, 4, 2, 1):
            low = min(low, shuffle_xor(low, mask))
            high = max(high, shuffle_xor(high, mask))
        if thread & u32(31) == 0:
            lows[thread >> u32(5)] = low
            highs[thread >> u32(5)] = high
        cuda.syncthreads()
        if thread == 0:
            for warp in range(1, 8):
                low = min(low, lows[u32(warp)])
                high = max(high, highs[u32(warp)])
            out[u32(u32(2) * block)] = low
            out[u32(u32(2) * block + u32(1))] = high

    result: Kernel = ranges
    return result


@kernel(array(i32), array(i32), block=64)
def join_ranges(parts, out):  # type: ignore[no-untyped-def]
    """Find the smallest and the largest pixel of each image from those of its parts, a lane to a part."""
    thread = u32(cuda.threadIdx.x)
    low = parts[u32(u32(2) * thread)]
    high = parts[u32(u32(2) * thread + u32(1))]
    for mask in (16, 8, 4, 2, 1):
        low = min(low, shuffle_xor(low, mask))
        high = max(high, shuffle_xor(high, mask))
    if thread & u32(31) == 0:
        out[u32(thread >> u32(4))] = low
        out[u32(u32(thread >> u32(4)) + u32(1))] = high


@kernel(array(f32), array(f32), i32, i32, block=128)
def flip(image, out, height, width):  # type: ignore[no-untyped-def]
    """Mirror a map."""
    index = u32(cuda.grid(1))
    if index < u32(u32(height) * u32(width)):
        x = u32(index % u32(width))
        out[u32(u32(index - x) + u32(u32(width) - u32(1) - x))] = image[index]


for _dtype in KINDS:
    take_kernel(_dtype)
    halve_kernel(_dtype)
    blur_rows_kernel(_dtype)
    ranges_kernel(_dtype)


def take(
    queue: Queue, image: Any, dtype: np.dtype[Any], out: Any, place: int, channels: int, mirrored: bool,
    shape: tuple[int, int],
) -> None:  # fmt: skip
    """Put one image, ``(H, W)`` or ``(H, W, 3)`` flat, as a grey one into place `place` of `out`."""
    copy_kernel = take_kernel(dtype)
    queue.launch(
        copy_kernel,
        blocks_for(shape[0] * shape[1], copy_kernel.block),
        image,
        out,
        place,
        channels,
        int(mirrored),
        *shape,
    )


def halve(
    queue: Queue, name: str, images: Any, dtype: np.dtype[Any], count: int, shape: tuple[int, int], largest: bool
) -> Any:
    """Return `count` images at half size: the mean of 2x2 pixels, or the `largest` of them."""
    size = count * ((shape[0] + 1) // 2) * ((shape[1] + 1) // 2)
    out = queue.array(name, size, dtype)
    mean_kernel = halve_kernel(dtype)
    queue.launch(mean_kernel, blocks_for(size, mean_kernel.block), images, out, count, *shape, int(largest))
    return out


def smooth(queue: Queue, images: Any, dtype: np.dtype[Any], sigma: float, shape: tuple[int, int]) -> Any:
    """Return both images blurred, 16 bit, as `stereokit.images.blur.smooth` does; `sigma` is above 0."""
    height, width = shape
    size = 2 * height * width
    weights = queue.cached("smooth.weights", sigma, lambda: gaussian_weights(sigma))
    half = gaussian_weights(sigma).size // 2
    rows = queue.array("smooth.rows", size, np.uint32)
    out = queue.array("smooth.out", size, np.uint16)
    row_kernel = blur_rows_kernel(dtype)
    queue.launch(row_kernel, blocks_for(size, row_kernel.block), images, weights, half, rows, 2 * height, width)
    queue.launch(blur_columns, blocks_for(size, blur_columns.block), rows, weights, half, out, 2, height, width)
    return out


def ranges(queue: Queue, images: Any, dtype: np.dtype[Any], pixels: int) -> Any:
    """Return (4,) int32 on the device: smallest and largest pixel of the left image, then of the right one."""
    parts = queue.array("ranges.parts", 4 * _PARTS, np.int32)
    out = queue.array("ranges", 4, np.int32)
    queue.launch(ranges_kernel(dtype), 2 * _PARTS, images, parts, pixels)
    queue.launch(join_ranges, 1, parts, out)
    return out
