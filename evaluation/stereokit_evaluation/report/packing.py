"""Disparity maps in a web page: exact to 1/32 pixel, as small as an image, and read without a canvas.

A canvas gives back 8 bits a channel, and some browsers change them against tracking; so maps are not hidden in
pictures. A map becomes whole numbers of 1/16 pixel, each predicted from its left, upper and upper left neighbour (the
median edge detector of JPEG-LS: Weinberger, Seroussi and Sapiro 2000, eq. 1); the differences, folded to positive
numbers, go as a plane of low and a plane of high bytes through zlib, which every browser undoes
(``DecompressionStream``). ``assets/maps.js`` is the reader.
"""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import InputError

__all__ = ["STEPS", "pack_map", "pack_mask", "unpack_map", "unpack_mask"]

STEPS = 16
"""Steps to a pixel of disparity."""


def pack_map(disparity: ArrayLike) -> dict[str, Any]:
    """Return a disparity map as JSON values.

    Parameters
    ----------
    disparity : (H, W) float
        Pixels, not finite where unknown.

    Returns
    -------
    dict
        ``width``, ``height``, ``steps`` to a pixel, ``low`` (the disparity of the stored number 1, pixels; 0 is
        unknown) and ``data``, base64.

    Raises
    ------
    InputError
        If `disparity` is no map, or spans 4095 pixels or more.
    """
    values = np.asarray(disparity, np.float64)
    if values.ndim != 2:
        raise InputError(f"disparity must have shape (H, W), got {values.shape}")
    known = np.isfinite(values)
    low = float(np.floor(values[known].min())) if known.any() else 0.0
    stored = np.where(known, np.rint((np.where(known, values, low) - low) * STEPS) + 1, 0)
    if stored.max(initial=0) > 65535:
        raise InputError(f"disparity must span less than 4095 pixels, got {stored.max() / STEPS:.0f}")
    stored = stored.astype(np.int32)
    # A difference of 16-bit numbers has 17 bits, but modulo 2**16 it carries the same information.
    change = (stored - _predicted(stored)).astype(np.int16).astype(np.int32)
    folded = ((change << 1) ^ (change >> 31)).astype(np.uint16)
    planes = np.stack([folded & 255, folded >> 8]).astype(np.uint8)
    height, width = values.shape
    return {"width": width, "height": height, "steps": STEPS, "low": low, "data": _text(planes)}


def unpack_map(packed: dict[str, Any]) -> NDArray[np.float32]:
    """Return the map of `pack_map`, (H, W) float32 pixels, NaN where unknown: the oracle of the page's reader."""
    height, width = packed["height"], packed["width"]
    planes = np.frombuffer(zlib.decompress(base64.b64decode(packed["data"])), np.uint8).reshape(2, height, width)
    folded = planes[0].astype(int) | planes[1].astype(int) << 8
    stored = np.zeros((height, width), int)
    for y in range(height):
        for x in range(width):
            west = stored[y, x - 1] if x else 0
            north = stored[y - 1, x] if y else 0
            corner = stored[y - 1, x - 1] if x and y else 0
            if corner >= max(west, north):
                guess = min(west, north)
            elif corner <= min(west, north):
                guess = max(west, north)
            else:
                guess = west + north - corner
            stored[y, x] = (guess + ((folded[y, x] >> 1) ^ -(folded[y, x] & 1))) & 65535
    values = packed["low"] + (stored - 1) / packed["steps"]
    return np.where(stored > 0, values, np.nan).astype(np.float32)


def pack_mask(mask: NDArray[np.bool_]) -> str:
    """Return a mask as base64 of its deflated bits, in reading order, the first in the highest bit of a byte."""
    return _text(np.packbits(mask))


def unpack_mask(text: str, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the mask of `pack_mask`."""
    bits = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    return np.unpackbits(bits, count=shape[0] * shape[1]).reshape(shape).astype(bool)


def _predicted(stored: NDArray[np.int32]) -> NDArray[np.int32]:
    wide = np.pad(stored, ((1, 0), (1, 0)))
    west, north, corner = wide[1:, :-1], wide[:-1, 1:], wide[:-1, :-1]
    least, most = np.minimum(west, north), np.maximum(west, north)
    guess: NDArray[np.int32] = np.where(corner >= most, least, np.where(corner <= least, most, west + north - corner))
    return guess


def _text(array: NDArray[np.uint8]) -> str:
    return base64.b64encode(zlib.compress(array.tobytes(), 9)).decode()
