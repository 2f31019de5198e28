"""Orientation tags: every format and every tag, against the picture that a viewer shows, built by hand."""

from __future__ import annotations

import struct
import warnings
import zlib
from io import BytesIO

import cv2
import numpy as np
import pytest

from stereokit import io
from stereokit.io.orientation import find_orientation, stored_window
from stereokit.large.sources import open_source
from stereokit.notices import PairWarning

GRAY = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 900, (40, 56)), (0, 0), 3)
SHOWN = np.clip(GRAY[:, :, None] + [120, 128, 136], 0, 255).astype(np.uint8)
# EXIF 4.6.4: where row 0 and column 0 of the stored image lie in the image as shown.
STORED = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, 1),  # row 0 is at the right side: shown after a turn to the right
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: np.rot90(a, -1),
}


def exif(tag, order="<"):
    mark = b"II*\0" if order == "<" else b"MM\0*"
    return mark + struct.pack(order + "IHHHIHHI", 8, 1, 0x112, 3, 1, tag, 0, 0)


def tagged(kind, image, tag, order="<"):
    """Return the content of a file with an orientation tag."""
    bgr = np.ascontiguousarray(image[:, :, ::-1])
    block = exif(tag, order)
    if kind == "jpg":
        data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
        segment = b"Exif\0\0" + block
        # an APP0 goes before it, and fill bytes may
        return data[:2] + b"\xff\xe0\x00\x04ab\xff\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + data[2:]
    if kind == "png":
        data = cv2.imencode(".png", bgr)[1].tobytes()
        chunk = struct.pack(">I", len(block)) + b"eXIf" + block + struct.pack(">I", zlib.crc32(b"eXIf" + block))
        return data[:33] + chunk + data[33:]
    if kind == "webp":
        data = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
        stream = data[data.index(b"VP8L") :]
        stream = stream[: 8 + int.from_bytes(stream[4:8], "little")]
        stream += b"\0" * (len(stream) % 2)
        height, width = image.shape[:2]
        sides = [(side - 1).to_bytes(3, "little") for side in (width, height)]
        head = b"VP8X" + struct.pack("<II", 10, 0x08) + b"".join(sides)
        body = b"WEBP" + head + stream + b"EXIF" + struct.pack("<I", len(block)) + block + b"\0" * (len(block) % 2)
        return b"RIFF" + struct.pack("<I", len(body)) + body
    tifffile = pytest.importorskip("tifffile", reason="TIFF is written with the extra 'large'")
    buffer = BytesIO()
    tifffile.imwrite(
        buffer, np.ascontiguousarray(image), photometric="rgb", metadata=None, extratags=[(0x112, 3, 1, tag, True)],
        byteorder=order, bigtiff=kind == "bigtiff", tile=(16, 16),
    )  # fmt: skip
    return buffer.getvalue()


@pytest.mark.parametrize("tag", STORED)
@pytest.mark.parametrize("kind", ["jpg", "png", "webp", "tif", "bigtiff"])
def test_images_are_read_as_they_are_shown(kind, tag, tmp_path):
    for order in "<>":
        path = tmp_path / f"a{order}.{kind}"
        path.write_bytes(tagged(kind, STORED[tag](SHOWN), tag, order))
        assert find_orientation(path.read_bytes()) == tag
        image = io.read_image(path)
        assert image.shape == SHOWN.shape and image.flags.c_contiguous
        difference = np.abs(image.astype(int) - SHOWN).max()
        assert difference <= (16 if kind == "jpg" else 0)
        assert np.abs(SHOWN.astype(int) - SHOWN[:, ::-1]).max() > 64  # a wrong turn would be seen


@pytest.mark.parametrize("tag", STORED)
def test_windows_of_a_tiff_are_those_of_the_image_as_shown(tag, tmp_path):
    path = tmp_path / "a.tif"
    path.write_bytes(tagged("tif", STORED[tag](SHOWN), tag))
    source = open_source("left", path)
    assert source.shape == SHOWN.shape and source.orientation == tag
    for y0, y1, x0, x1 in ((0, 40, 0, 56), (3, 29, 17, 50), (39, 40, 55, 56), (0, 1, 0, 56)):
        np.testing.assert_array_equal(source.read(y0, y1, x0, x1), SHOWN[y0:y1, x0:x1])
    assert stored_window(1, 40, 56, 3, 29, 17, 50) == (3, 29, 17, 50)


@pytest.mark.parametrize("kind", ["jpg", "png", "webp", "tif"])
def test_broken_tags_and_cut_files_are_upright(kind, tmp_path):
    data = tagged(kind, SHOWN, 6)
    for bad in (0, 9, 65535):
        assert find_orientation(tagged(kind, SHOWN, bad)) == 1
    for end in range(0, min(len(data), 400), 3):
        assert find_orientation(data[:end]) in (1, 6)
    assert find_orientation(b"") == find_orientation(b"\xff\xd8" + b"\xff" * 9) == 1


def test_a_pair_of_two_orientations_is_warned_of(tmp_path):
    for name, tag in (("a", 6), ("b", 1), ("c", 6)):
        (tmp_path / f"{name}.jpg").write_bytes(tagged("jpg", STORED[tag](SHOWN), tag))
    with pytest.warns(PairWarning, match="orientation tags of left and right differ, 6 and 1"):
        left, right = io.read_pair(tmp_path / "a.jpg", tmp_path / "b.jpg")
    assert left.shape == right.shape == SHOWN.shape
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        io.read_pair(tmp_path / "a.jpg", tmp_path / "c.jpg")
