"""Image files: read by their content, upright as in a viewer; written by their suffix."""

from __future__ import annotations

import io
import logging
import os
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import FileError, InputError
from stereokit.images.check import accepted_type
from stereokit.images.intensity import to_gray
from stereokit.io.atomic import check_output, write_bytes
from stereokit.io.claims import check_claim
from stereokit.io.orientation import UPRIGHT, find_orientation, oriented, without_orientation
from stereokit.io.quiet import quiet_decoders
from stereokit.io.reading import parsing, read_bytes, read_npy
from stereokit.notices import PairWarning, warn

__all__ = [
    "IMAGE_SUFFIXES",
    "NPY_START",
    "READABLE_SUFFIXES",
    "TIFF_STARTS",
    "check_orientations",
    "decode",
    "decode_bytes",
    "describe",
    "encode",
    "open_tiff",
    "plain_image",
    "read_image",
    "read_oriented",
    "read_pair",
    "write_image",
]

IMAGE_SUFFIXES = (".png", ".tiff", ".tif", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm")
"""The suffixes of `write_image`."""

READABLE_SUFFIXES = (*IMAGE_SUFFIXES, ".webp", ".jp2", ".avif", ".gif", ".pnm", ".pbm", ".npy")
"""The suffixes of images in searches by name. `read_image` itself goes by the content."""

_DEEP = {
    "uint16": (".png", ".tiff", ".tif", ".pgm", ".ppm"),
    "float32": (".tiff", ".tif"),
    "float64": (".tiff", ".tif"),
}
NPY_START = b"\x93NUMPY"
TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # its log repeats its exceptions


def read_image(path: str | os.PathLike[str], gray: bool = False, alpha: bool = False) -> NDArray[Any]:
    """Read an image as viewers show it.

    Parameters
    ----------
    path : path
        Anything that OpenCV decodes (PNG, JPEG, TIFF, BMP, PGM, PPM, WebP ...), npy, and TIFF of other compressions
        with ``stereokit[tiff]``.
    gray : bool
        Turn colour into grey (0.299 R + 0.587 G + 0.114 B).
    alpha : bool
        Keep the alpha channel of a picture that has transparent pixels, which `stereokit.match` then leaves out. Of a
        TIFF it is dropped, whose fourth channel may be anything.

    Returns
    -------
    (H, W), (H, W, 3) or, with `alpha`, (H, W, 4) uint8, uint16, float32 or float64
        Grey, RGB or RGBA. Palettes are resolved, orientation tags are applied.

    Raises
    ------
    FileError
        If the file is missing or is not an image of these types.
    """
    return read_oriented(path, gray, alpha)[0]


def read_pair(
    left: str | os.PathLike[str], right: str | os.PathLike[str], gray: bool = False, alpha: bool = False
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Read the two images of a pair, as `read_image`; warn where their orientation tags differ.

    Raises
    ------
    FileError
        If a file is missing or is not an image.
    """
    (a, tag_a), (b, tag_b) = (read_oriented(path, gray, alpha) for path in (left, right))
    check_orientations(tag_a, tag_b)
    return a, b


def check_orientations(left: int, right: int) -> None:
    """Warn if the orientation tags of the two views differ."""
    if left != right:
        warn(
            f"the orientation tags of left and right differ, {left} and {right}, and each was applied: "
            "the views of a rectified pair have one orientation",
            PairWarning,
        )


def read_oriented(path: str | os.PathLike[str], gray: bool = False, alpha: bool = False) -> tuple[NDArray[Any], int]:
    """Return an image as `read_image` does, and the orientation tag that was applied.

    Raises
    ------
    FileError
        If the file is missing or is not an image.
    """
    image, tag = decode(path)
    return plain_image(path, image, gray, alpha), tag


def plain_image(
    path: str | os.PathLike[str], image: NDArray[Any], gray: bool = False, alpha: bool = False
) -> NDArray[Any]:
    """Return a decoded image as `read_image` does: of an accepted type, grey or RGB, RGBA if wanted.

    Raises
    ------
    FileError
        If it has another type or number of channels.
    """
    kind = accepted_type(image.dtype)
    if kind is None:
        raise FileError(f"{str(path)!r} holds {image.dtype} pixels, expected whole or floating-point numbers")
    image = image.astype(kind, copy=False)
    if image.ndim == 2 or image.shape[2] == 1:
        return np.ascontiguousarray(image.reshape(image.shape[:2]))
    if image.shape[2] not in (3, 4):
        raise FileError(f"{str(path)!r} has {image.shape[2]} channels, expected grey or colour")
    colors = np.ascontiguousarray(image[:, :, :3])
    colors = to_gray(colors) if gray else colors
    if alpha and image.shape[2] == 4 and not image[:, :, 3].all():
        return np.dstack([colors if colors.ndim == 3 else [colors] * 3, image[:, :, 3]])
    return colors


def write_image(path: str | os.PathLike[str], array: ArrayLike) -> None:
    """Write an image; the format follows from the suffix.

    Parameters
    ----------
    path : path
        Ends in one of `IMAGE_SUFFIXES`.
    array : (H, W) or (H, W, 3) uint8, uint16, float32 or float64
        Grey or RGB. uint16 goes to PNG, TIFF, PGM and PPM, floats to TIFF only; PGM is grey, PPM is colour.

    Raises
    ------
    InputError
        If `array` has another shape or type, or a type that the format cannot hold.
    FileError
        If the suffix is unknown or the file cannot be written.
    """
    target = check_output(path, IMAGE_SUFFIXES)
    image = np.asarray(array)
    if image.size == 0 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise InputError(f"array must be (H, W) or (H, W, 3) and not empty, got shape {image.shape}")
    kind, suffix = str(image.dtype), target.suffix.lower()
    if kind not in ("uint8", *_DEEP):
        raise InputError(f"array must be uint8, uint16, float32 or float64, got {kind}")
    if suffix not in _DEEP.get(kind, IMAGE_SUFFIXES):
        raise InputError(f"array of {kind} cannot be stored as {suffix}; use one of {', '.join(_DEEP[kind])}")
    if (suffix, image.ndim) in ((".pgm", 3), (".ppm", 2)):
        raise InputError(
            f"array for {suffix} must be {'(H, W)' if image.ndim == 3 else '(H, W, 3)'}, got {image.shape}"
        )
    write_bytes(target, encode(suffix, image))


def decode(path: str | os.PathLike[str]) -> tuple[NDArray[Any], int]:
    """Return an image of any type, grey, RGB or RGBA, as viewers show it, and its orientation tag.

    Raises
    ------
    FileError
        If the file is missing or is not an image.
    """
    return decode_bytes(path, read_bytes(path))


def decode_bytes(path: str | os.PathLike[str], data: bytes) -> tuple[NDArray[Any], int]:
    """Return the image that a file of this content holds; see `decode`."""
    with parsing(path, "image"):
        if data.startswith(NPY_START):
            image, tag = read_npy(path, data), UPRIGHT
            if image.ndim not in (2, 3) or image.size == 0:
                raise FileError(f"{str(path)!r} must hold an array of an image, got {describe(image)}")
            return image.astype(image.dtype.newbyteorder("="), copy=False), tag
        tag = find_orientation(data)
        if data.startswith(TIFF_STARTS):
            upright = without_orientation(data)  # which some versions of OpenCV apply
            pixels = _with_opencv(upright)
            pixels = _with_tifffile(path, upright) if pixels is None else pixels
        else:
            check_claim(path, data)
            pixels = _with_opencv(data)
        if pixels is None:
            format_name = {".npy": "npy file", ".tif": "TIFF", ".tiff": "TIFF"}.get(os.path.splitext(path)[1].lower())
            reason = "is not an image that can be read" if format_name is None else f"is not a readable {format_name}"
            raise FileError(f"{str(path)!r} {reason}")
        return oriented(pixels, tag), tag


def open_tiff(path: str | os.PathLike[str], file: Any) -> Any:
    """Return the first page of a TIFF as tifffile has it, None if its stored values are not its grey or RGB pixels.

    Parameters
    ----------
    path : path
        For messages.
    file : tifffile.TiffFile

    Raises
    ------
    FileError
        If there is no page.
    """
    if not len(file.pages):
        raise FileError(f"{str(path)!r} is a TIFF without an image")
    page = file.pages.first
    interleaved = page.planarconfig == 1 or page.samplesperpixel == 1
    readable = str(getattr(page.photometric, "name", page.photometric)) in ("MINISBLACK", "RGB")
    kind = "" if page.dtype is None else str(page.dtype)
    readable_type = kind in ("uint8", *_DEEP) and page.bitspersample == 8 * page.dtype.itemsize
    return (
        page
        if interleaved and readable and readable_type and page.samplesperpixel in (1, 3, 4) and page.imagedepth == 1
        else None
    )


def _with_opencv(data: bytes) -> NDArray[Any] | None:
    if not data:
        return None
    try:
        with quiet_decoders():
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    if image is None:
        return None
    if image.ndim == 2 or image.shape[2] < 3:
        return image
    return np.asarray(image[:, :, [2, 1, 0, 3][: image.shape[2]]])


def _with_tifffile(path: str | os.PathLike[str], data: bytes) -> NDArray[Any]:
    """Return the first page of a TIFF that OpenCV does not decode."""
    try:
        import tifffile
    except ModuleNotFoundError:
        raise FileError(
            f"{str(path)!r} is a TIFF that cannot be decoded here, broken or of a rare compression; "
            "pip install 'stereokit[tiff]' reads more"
        ) from None
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page = open_tiff(path, file)
        if page is None:
            first = file.pages.first
            layout = f"{getattr(first.photometric, 'name', first.photometric)}, {first.samplesperpixel} x {first.dtype}"
            raise FileError(f"{str(path)!r} is a TIFF of a kind that cannot be decoded ({layout})")
        image = np.asarray(page.asarray())
        if image.ndim not in (2, 3) or image.size == 0:
            raise FileError(f"{str(path)!r} is a TIFF whose pixels cannot be decoded, got {describe(image)}")
        return image


def encode(suffix: str, image: NDArray[Any]) -> bytes:
    """Return an image, grey or RGB, as the content of a file.

    Raises
    ------
    FileError
        If the format cannot hold it.
    """
    stored = image if image.ndim == 2 else image[:, :, ::-1]  # OpenCV wants BGR
    # By default OpenCV 4 stores float colour in TIFF as LogLuv, which loses digits; 5 is LZW.
    settings = [cv2.IMWRITE_TIFF_COMPRESSION, 5] if suffix.startswith(".tif") else []
    try:
        with quiet_decoders():
            ok, data = cv2.imencode(suffix, np.ascontiguousarray(stored), settings)
    except cv2.error as error:
        raise FileError(f"cannot encode {describe(image)} as {suffix}") from error
    if not ok:
        raise FileError(f"cannot encode {describe(image)} as {suffix}")
    return data.tobytes()


def describe(array: Any) -> str:
    """Return the type and shape of an array, for messages."""
    return f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
