"""Files: images, disparity maps (KITTI 16-bit PNG, PFM, npy, float TIFF), OpenCV's fixed point, PLY clouds.

Sources: KITTI stereo devkit (``readme.txt``, ``io_disp.h``: ``uint16 = disparity * 256``, 0 is invalid); the
PFM of Middlebury 2014 (rows bottom-up, the sign of the scale gives the byte order, its magnitude is unused);
OpenCV's ``StereoMatcher::DISP_SHIFT`` (16 steps a pixel, invalid is one pixel below the minimum).

Every writer builds the whole file first, writes it to a temporary name beside the target and then renames it,
so that a failure never leaves half a file. PFM is read and written here because what OpenCV does with its row
order and its scale depends on the version.
"""

from __future__ import annotations

import io
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import FileError, InputError, OptionError
from stereokit.images.intensity import to_gray

__all__ = [
    "DISPARITY_SUFFIXES",
    "IMAGE_SUFFIXES",
    "check_output",
    "from_opencv",
    "read_disparity",
    "read_image",
    "replacing",
    "to_opencv",
    "write_bytes",
    "write_disparity",
    "write_image",
    "write_ply",
]

DISPARITY_SUFFIXES = (".png", ".pfm", ".npy", ".tiff")
"""What `read_disparity` and `write_disparity` know; ``.tif`` is taken as ``.tiff``."""

IMAGE_SUFFIXES = (".png", ".tiff", ".tif", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm")
"""What `write_image` knows."""

_DEEP = {
    "uint16": (".png", ".tiff", ".tif", ".pgm", ".ppm"),
    "float32": (".tiff", ".tif"),
    "float64": (".tiff", ".tif"),
}
_PFM_HEADER = re.compile(rb"(P[fF])\s+(\d+)\s+(\d+)\s+([-+]?[0-9.]+(?:[eE][-+]?\d+)?)(?:\r\n|[ \t]*\n|\s)")
_STEPS = 16  # of OpenCV's fixed point in a pixel


def check_output(path: str | os.PathLike[str], suffixes: tuple[str, ...] = (), name: str = "path") -> Path:
    """Return `path`, checked before any work is done for it: known suffix, existing folder.

    Parameters
    ----------
    path : path
        A file that is to be written.
    suffixes : tuple of str
        The suffixes that are known, lower case with their dot; empty to take any.
    name : str
        What the message calls the argument.

    Raises
    ------
    FileError
        If the suffix is unknown, the folder is missing or `path` is a folder.
    """
    target = Path(path)
    if suffixes and target.suffix.lower() not in suffixes:
        raise FileError(f"{name} must end in one of {', '.join(suffixes)}, got {str(path)!r}")
    if not target.parent.is_dir():
        raise FileError(f"{name} {str(path)!r}: the folder {str(target.parent)!r} does not exist")
    if target.is_dir():
        raise FileError(f"{name} {str(path)!r} is a folder, expected a file")
    return target


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside `path`; what is written there gets that name when the block ends well.

    Raises
    ------
    FileError
        If the folder is missing or the file cannot be written. An existing file is then left as it was.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise FileError(f"cannot write {str(path)!r}: the folder {str(target.parent)!r} does not exist")
    temporary = target.parent / f".{secrets.token_hex(8)}.tmp"
    try:
        try:
            yield temporary
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise FileError(f"cannot write {str(path)!r}: {error.strerror or error}") from error


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write `data` to `path`, all of it or nothing.

    Raises
    ------
    FileError
        If the folder is missing or the file cannot be written. An existing file is then left as it was.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def make_folder(name: str, path: str | os.PathLike[str]) -> None:
    """Make the folder `path` and those above it, unless it is there.

    Parameters
    ----------
    name : str
        What the caller's argument is called, for the message.

    Raises
    ------
    FileError
        If it cannot be made.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"{name} must be a folder, got {str(path)!r} ({error.strerror or error})") from error


def read_image(path: str | os.PathLike[str], gray: bool = False) -> NDArray[Any]:
    """Read an image as it is stored.

    Parameters
    ----------
    path : path
        Anything that OpenCV decodes: PNG, JPEG, TIFF, BMP, PGM, PPM ...
    gray : bool
        Turn colour into grey (0.299 R + 0.587 G + 0.114 B).

    Returns
    -------
    (H, W) or (H, W, 3) uint8, uint16, float32 or float64
        Grey or RGB. Alpha is dropped, palettes are resolved, rotation tags are not applied.

    Raises
    ------
    FileError
        If the file is missing or is not an image of these types.
    """
    image = _decode(path)
    if str(image.dtype) not in ("uint8", *_DEEP):
        raise FileError(f"{str(path)!r} holds {image.dtype} pixels, expected uint8, uint16 or float")
    if image.ndim == 2:
        return image
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[:, :, 0])
    if image.shape[2] not in (3, 4):
        raise FileError(f"{str(path)!r} has {image.shape[2]} channels, expected grey or colour")
    colors = np.ascontiguousarray(image[:, :, 2::-1])
    return to_gray(colors) if gray else colors


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
        raise InputError(f"array of {kind} cannot be kept in {suffix}; use one of {', '.join(_DEEP[kind])}")
    if (suffix, image.ndim) in ((".pgm", 3), (".ppm", 2)):
        raise InputError(
            f"array for {suffix} must be {'(H, W)' if image.ndim == 3 else '(H, W, 3)'}, got {image.shape}"
        )
    write_bytes(target, _encode(suffix, image))


def read_disparity(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Read a disparity map.

    Parameters
    ----------
    path : path
        ``.png`` (KITTI, 16-bit grey: value / 256, 0 invalid), ``.pfm`` (grey), ``.npy``, ``.tiff`` (pixels).

    Returns
    -------
    (H, W) float32
        Pixels, NaN where invalid (infinite in the file, or 0 in a PNG).

    Raises
    ------
    FileError
        If the file is missing, has another suffix or does not hold such a map.
    """
    suffix = _suffix(path)
    if suffix == ".png":
        stored = _decode(path)
        if stored.dtype != np.uint16 or stored.ndim != 2:
            raise FileError(f"{str(path)!r} must be a 16-bit grey PNG, got {_describe(stored)}")
        disparity: NDArray[np.float32] = stored.astype(np.float32) / np.float32(256)
        disparity[stored == 0] = np.nan
        return disparity
    if suffix == ".pfm":
        array: NDArray[Any] = _read_pfm(path)
    elif suffix == ".npy":
        try:
            array = np.load(io.BytesIO(_read_bytes(path)), allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise FileError(f"{str(path)!r} is not a readable npy file") from error
    else:
        array = _decode(path)
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "fiu":
        raise FileError(f"{str(path)!r} must hold a 2-d array of numbers, got {_describe(array)}")
    disparity = array.astype(np.float32)
    disparity[~np.isfinite(disparity)] = np.nan
    return disparity


def write_disparity(path: str | os.PathLike[str], disparity: ArrayLike) -> None:
    """Write a disparity map; the format follows from the suffix.

    Parameters
    ----------
    path : path
        ``.png``: KITTI, 16-bit, 1/256 pixel, 0 where invalid. As in the devkit, valid values are brought into
        what the format can say, 1/256 to 65535/256 pixels. ``.pfm``: infinite where invalid. ``.npy`` and
        ``.tiff``: float32, NaN kept.
    disparity : (H, W) float
        Pixels, not finite where invalid.

    Raises
    ------
    InputError
        If `disparity` is not a 2-d array of floats, or is negative somewhere and the file is a ``.png``.
    FileError
        If the suffix is unknown or the file cannot be written.
    """
    suffix = _suffix(path)
    values = _checked_map(disparity)
    known = np.isfinite(values)
    if suffix == ".png":
        if known.any() and values[known].min() < 0:
            lowest = values[known].min()
            raise InputError(f"disparity must not be negative for KITTI's .png (use .pfm, .npy), got {lowest:g}")
        steps = np.where(known, values, np.float32(0)) * np.float32(256)
        data = _encode(".png", np.where(known, np.clip(np.rint(steps), 1, 65535), 0).astype(np.uint16))
    elif suffix == ".pfm":
        rows = np.where(known, values, np.float32(np.inf))[::-1].astype("<f4")
        data = b"Pf\n%d %d\n-1.0\n" % (values.shape[1], values.shape[0]) + rows.tobytes()
    elif suffix == ".npy":
        buffer = io.BytesIO()
        np.save(buffer, values)
        data = buffer.getvalue()
    else:
        data = _encode(".tiff", values)
    write_bytes(path, data)


def from_opencv(fixed: ArrayLike, min_disparity: int = 0) -> NDArray[np.float32]:
    """Return OpenCV's fixed-point disparity in pixels.

    Parameters
    ----------
    fixed : (H, W) int16
        What ``StereoBM.compute`` and ``StereoSGBM.compute`` return: 16 steps a pixel.
    min_disparity : int
        The matcher's ``minDisparity``, pixels. ``(min_disparity - 1) * 16`` marks invalid pixels.

    Returns
    -------
    (H, W) float32
        Pixels, NaN where invalid.

    Raises
    ------
    InputError
        If `fixed` is not a 2-d int16 array.
    OptionError
        If the mark of invalid pixels does not fit 16 bits.
    """
    mark = _mark(min_disparity)
    steps = np.asarray(fixed)
    if steps.ndim != 2 or steps.dtype != np.int16:
        raise InputError(f"fixed must be (H, W) int16, got {_describe(steps)}")
    disparity: NDArray[np.float32] = steps.astype(np.float32) / np.float32(_STEPS)
    disparity[steps <= mark] = np.nan
    return disparity


def to_opencv(disparity: ArrayLike, min_disparity: int = 0) -> NDArray[np.int16]:
    """Return a disparity map in OpenCV's fixed point, the inverse of `from_opencv`.

    Parameters
    ----------
    disparity : (H, W) float
        Pixels, not finite where invalid.
    min_disparity : int
        ``minDisparity`` of the matcher it stands for, pixels.

    Raises
    ------
    InputError
        If `disparity` is not a 2-d array of floats, or a value would collide with the mark of invalid pixels
        or does not fit 16 bits.
    OptionError
        If the mark of invalid pixels does not fit 16 bits.
    """
    mark = _mark(min_disparity)
    values = _checked_map(disparity)
    known = np.isfinite(values)
    steps = np.rint(np.where(known, values, np.float32(0)) * np.float32(_STEPS))
    if np.any(known & ((steps <= mark) | (steps > 32767))):
        raise InputError(f"disparity must lie above {min_disparity - 1} and below 2048 pixels, got others")
    return np.where(known, steps, mark).astype(np.int16)


def write_ply(path: str | os.PathLike[str], points: ArrayLike, colors: ArrayLike | None = None) -> None:
    """Write a point cloud as binary little-endian PLY.

    Parameters
    ----------
    path : path
        Ends in ``.ply``.
    points : (N, 3) float
        Metres, finite; kept as float32.
    colors : (N, 3) uint8, optional
        RGB of each point.

    Raises
    ------
    InputError
        If a shape or type is wrong or a point is not finite.
    FileError
        If the suffix is unknown or the file cannot be written.
    """
    target = check_output(path, (".ply",))
    xyz = np.asarray(points)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind != "f":
        raise InputError(f"points must be (N, 3) float, got {_describe(xyz)}")
    if not np.isfinite(xyz).all():
        raise InputError("points must be finite, got NaN or infinity; drop those points first")
    fields = [(name, "<f4") for name in ("x", "y", "z")]
    if colors is not None:
        rgb = np.asarray(colors)
        if rgb.shape != xyz.shape or rgb.dtype != np.uint8:
            raise InputError(f"colors must be {xyz.shape} uint8 as points, got {_describe(rgb)}")
        fields += [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.empty(len(xyz), dtype=fields)
    for k, (name, _) in enumerate(fields):
        vertices[name] = xyz[:, k] if k < 3 else rgb[:, k - 3]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    lines += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in fields]
    write_bytes(target, "\n".join([*lines, "end_header", ""]).encode("ascii") + vertices.tobytes())


def _suffix(path: str | os.PathLike[str]) -> str:
    suffix = Path(path).suffix.lower()
    suffix = ".tiff" if suffix == ".tif" else suffix
    if suffix not in DISPARITY_SUFFIXES:
        known = ", ".join(DISPARITY_SUFFIXES)
        raise FileError(f"disparity file must end in one of {known}, got {str(path)!r}")
    return suffix


def _mark(min_disparity: int) -> int:
    mark = (min_disparity - 1) * _STEPS
    if not -32768 <= mark <= 32767:
        raise OptionError(f"min_disparity must lie in -2047 .. 2048 for 16 bits, got {min_disparity}")
    return mark


def _describe(array: Any) -> str:
    return f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__


def _checked_map(disparity: ArrayLike) -> NDArray[np.float32]:
    values = np.asarray(disparity)
    if values.ndim != 2 or values.size == 0 or values.dtype.kind != "f":
        raise InputError(f"disparity must be (H, W) float and not empty, got {_describe(values)}")
    return np.ascontiguousarray(values, dtype=np.float32)


def _read_bytes(path: str | os.PathLike[str]) -> bytes:
    try:
        return Path(path).read_bytes()
    except FileNotFoundError as error:
        raise FileError(f"no such file: {str(path)!r}") from error
    except OSError as error:
        raise FileError(f"cannot read {str(path)!r}: {error.strerror or error}") from error


def _decode(path: str | os.PathLike[str]) -> NDArray[Any]:
    data = _read_bytes(path)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise FileError(f"{str(path)!r} is not an image that can be read")
    return np.asarray(image)


def _encode(suffix: str, image: NDArray[Any]) -> bytes:
    stored = image if image.ndim == 2 else image[:, :, ::-1]  # OpenCV wants BGR
    # Left to itself, OpenCV 4 keeps float colour in TIFF as LogLuv, which loses digits; 5 is LZW.
    settings = [cv2.IMWRITE_TIFF_COMPRESSION, 5] if suffix.startswith(".tif") else []
    try:
        ok, data = cv2.imencode(suffix, np.ascontiguousarray(stored), settings)
    except cv2.error as error:
        raise FileError(f"cannot encode {_describe(image)} as {suffix}") from error
    if not ok:
        raise FileError(f"cannot encode {_describe(image)} as {suffix}")
    return data.tobytes()


def _read_pfm(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    data = _read_bytes(path)
    header = _PFM_HEADER.match(data)
    if header is None:
        raise FileError(f"{str(path)!r} has no PFM header")
    if header[1] == b"PF":
        raise FileError(f"{str(path)!r} is a colour PFM, expected a grey one (Pf)")
    width, height = int(header[2]), int(header[3])
    try:
        scale = float(header[4])
    except ValueError:
        scale = 0.0
    expected, present = 4 * width * height, len(data) - header.end()
    if scale == 0 or expected == 0 or present < expected:
        raise FileError(
            f"{str(path)!r} is a broken PFM: size {width}x{height}, scale {header[4].decode()}, "
            f"{present} bytes of data where {expected} are needed"
        )
    values = np.frombuffer(data, "<f4" if scale < 0 else ">f4", width * height, header.end())
    return values.reshape(height, width)[::-1].astype(np.float32)
