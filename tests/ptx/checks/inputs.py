"""Grey, half size, Gaussian and ranges on a queue, against OpenCV and NumPy: equal to the last bit."""

from __future__ import annotations

import numpy as np

from stereokit.cuda.kernel import blocks_for
from stereokit.images import blur, gray, prepare_cuda, resize

SHAPES = [(1, 1), (5, 33), (8, 7)]


def _pair(shape: tuple[int, ...], dtype: type, seed: int = 0) -> np.ndarray:
    low, high = (3, 250) if dtype is np.uint8 else (900, 65535)
    return np.random.default_rng(seed).integers(low, high, (2, *shape), dtype, endpoint=True)


def _halfway(dtype: type) -> np.ndarray:
    """Return colors, ``(1, N, 3)``, whose weighted mean lies halfway between two grey levels."""
    red, green = np.random.default_rng(0).integers(0, 256, (2, 70000))
    blue = (2**14 - 9798 * red - 19235 * green) * pow(3735, -1, 2**15) % 2**15
    fits = blue <= np.iinfo(dtype).max
    return np.stack([red, green, blue], axis=1)[fits][:300].astype(dtype)[None]


def check_grey(queue, dtype=np.uint8):
    """Compare random colors and, last, those that rounding decides."""
    ties = _halfway(dtype)
    assert ties.shape[1] > 250
    for colour in [*(_pair((*shape, 3), dtype) for shape in SHAPES), np.stack([ties, ties[:, ::-1]])]:
        shape = height, width = colour.shape[1:3]
        want = gray.gray_pair(*colour)
        out = queue.array("pair", 2 * height * width, dtype)
        for place, image in enumerate(colour):
            flat = queue.upload(f"in{place}", image)
            prepare_cuda.take(queue, flat, np.dtype(dtype), out, place, 3, False, shape)
        np.testing.assert_array_equal(queue.fetch(out).reshape(2, *shape), [want.left, want.right])


def check_mirrored(queue, dtype=np.uint8):
    for shape in SHAPES:
        image = _pair(shape, dtype)[0]
        out = queue.array("pair", 2 * image.size, dtype)
        for place, mirrored in enumerate((False, True)):
            flat = queue.upload("in", image)
            prepare_cuda.take(queue, flat, np.dtype(dtype), out, place, 1, mirrored, shape)
        np.testing.assert_array_equal(queue.fetch(out).reshape(2, *shape), [image, image[:, ::-1]])


def check_flipped(queue):
    for height, width in SHAPES:
        image = np.random.default_rng(0).normal(size=(height, width)).astype(np.float32)
        out = queue.array("out", image.size, np.float32)
        blocks = blocks_for(image.size, prepare_cuda.flip.block)
        queue.launch(prepare_cuda.flip, blocks, queue.upload("in", image), out, height, width)
        np.testing.assert_array_equal(queue.fetch(out).reshape(image.shape), image[:, ::-1])


def check_halved(queue, dtype=np.uint8):
    for shape in SHAPES:
        pair = _pair(shape, dtype)
        bad = np.random.default_rng(1).random((2, *shape)) < 0.2
        want = resize.half_size(gray.GrayPair(*pair, *bad, pair[0].astype(np.uint8)))
        half = queue.upload("in", pair)
        out = prepare_cuda.halve(queue, "half", half, np.dtype(dtype), 2, shape, False)
        np.testing.assert_array_equal(queue.fetch(out).reshape(2, *want.left.shape), [want.left, want.right])
        masks = queue.upload("bad", bad.view(np.uint8))
        out = prepare_cuda.halve(queue, "half.bad", masks, np.dtype(np.uint8), 2, shape, True)
        masks = queue.fetch(out).reshape(2, *want.left.shape)
        np.testing.assert_array_equal(masks != 0, [want.left_bad, want.right_bad])


def check_blurred(queue, dtype=np.uint8, sigmas=(0.3, 0.7, 2.0)):
    for shape, sigma in zip(SHAPES, sigmas, strict=True):
        pair = _pair(shape, dtype)
        want = blur.smooth(gray.GrayPair(*pair, None, None, pair[0].astype(np.uint8)), sigma)
        out = prepare_cuda.smooth(queue, queue.upload("in", pair), np.dtype(dtype), sigma, shape)
        np.testing.assert_array_equal(queue.fetch(out).reshape(2, *shape), [want.left, want.right])


def check_ranges(queue, dtype=np.uint8):
    for shape in ((1, 1), (19, 33), (130, 70)):
        pair = _pair(shape, dtype)
        out = prepare_cuda.ranges(queue, queue.upload("in", pair), np.dtype(dtype), pair[0].size)
        want = [pair[0].min(), pair[0].max(), pair[1].min(), pair[1].max()]
        np.testing.assert_array_equal(queue.fetch(out), want)
