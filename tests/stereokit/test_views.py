"""Pairs in one file: halves, pages of a TIFF, pictures of an MPO."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from stereokit.errors import FileError, OptionError
from stereokit.io.views import LAYOUTS, read_views, split_views

tifffile = pytest.importorskip("tifffile")


def pair(dtype=np.uint8, channels=(), size=(20, 30)):
    rng = np.random.default_rng(0)
    return [rng.integers(0, np.iinfo(dtype).max, (*size, *channels), dtype, endpoint=True) for _ in range(2)]


def mpo(images, order="<", lengths=None):
    """Return a Multi-Picture Format file as CIPA DC-007 describes it: the first JPEG has the index in APP2."""
    parts = [cv2.imencode(".jpg", image)[1].tobytes() for image in images]
    size = 4 + 4 + 8 + 2 + 12 + 4 + 16 * len(parts)  # marker and length, MPF\0, header, count, one entry, next, index
    total = len(parts[0]) + size
    entries, at = b"", total
    for k, part in enumerate(parts):
        length = total if k == 0 else len(part)
        # the second part begins where the first ends; offsets count from the byte order mark
        entries += struct.pack(order + "IIIHH", 0, length, 0 if k == 0 else at - (2 + 4 + 4), 0, 0)
        at += len(part) if k else 0
    body = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(order + "I", 8)
    body += (
        struct.pack(order + "HHHII", 1, 0xB002, 7, len(entries) if lengths is None else lengths, 8 + 2 + 12 + 4)
        + b"\0\0\0\0"
        + entries
    )
    segment = b"\xff\xe2" + struct.pack(">H", len(body) + 6) + b"MPF\0" + body
    assert len(segment) == size
    return parts[0][:2] + segment + parts[0][2:] + b"".join(parts[1:])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_every_layout(tmp_path, dtype, channels):
    left, right = pair(dtype, channels)
    stored = {
        "side-by-side": np.hstack([left, right]),
        "right-left": np.hstack([right, left]),
        "top-bottom": np.vstack([left, right]),
        "bottom-top": np.vstack([right, left]),
    }
    assert {*stored, "pages"} == set(LAYOUTS)
    for layout, image in stored.items():
        path = tmp_path / f"{layout}.png"
        assert cv2.imwrite(str(path), image if not channels else image[..., ::-1])
        for got, expected in zip(read_views(path, layout), (left, right), strict=True):
            assert np.array_equal(got, expected)
            assert got.flags.c_contiguous
    assert np.array_equal(read_views(tmp_path / "side-by-side.png")[1], right)  # wide enough to tell
    path = tmp_path / "pages.tiff"
    tifffile.imwrite(path, np.stack([left, right]), photometric="rgb" if channels else "minisblack")
    for layout in (None, "pages"):
        for got, expected in zip(read_views(path, layout), (left, right), strict=True):
            assert np.array_equal(got, expected)


def test_grey_is_that_of_single_images(tmp_path):
    left, right = pair(channels=(3,))
    cv2.imwrite(str(tmp_path / "a.png"), np.hstack([left, right])[..., ::-1])
    got = read_views(tmp_path / "a.png", gray=True)
    assert [view.shape for view in got] == [(20, 30)] * 2


def test_pages_of_a_compression_that_opencv_lacks(tmp_path):
    pytest.importorskip("imagecodecs")
    left, right = pair(np.uint16)
    path = tmp_path / "pages.tif"
    with tifffile.TiffWriter(path) as writer:
        for view in (left, right):
            writer.write(view, compression="zstd")
    got = read_views(path)
    assert np.array_equal(got[0], left)
    assert np.array_equal(got[1], right)


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_pictures_of_an_mpo(tmp_path, order):
    images = [cv2.GaussianBlur(image, (0, 0), 3) for image in pair(size=(40, 50))]
    path = tmp_path / "a.mpo"
    path.write_bytes(mpo(images, order))
    for got, image in zip(read_views(path), images, strict=True):
        alone = cv2.imdecode(cv2.imencode(".jpg", image)[1], cv2.IMREAD_UNCHANGED)
        assert np.array_equal(got, alone)


@pytest.mark.parametrize(
    ("layout", "size", "line"),
    [
        (
            None,
            (20, 39),
            "one picture of 39x20 pixels does not tell where its two views are; layout can be side-by-side",
        ),
        ("side-by-side", (20, 39), "must have an even width, got 39"),
        ("right-left", (20, 41), "must have an even width, got 41"),
        ("top-bottom", (21, 40), "must have an even height, got 21"),
        ("pages", (20, 40), "must hold two pictures, got 1"),
        (None, (20, 41), "must have an even width, got 41"),
    ],
)
def test_pictures_without_two_views_are_refused(tmp_path, layout, size, line):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.zeros(size, np.uint8))
    with pytest.raises(FileError, match=line) as caught:
        read_views(path, layout)
    assert str(path) in str(caught.value)


def test_other_refusals(tmp_path):
    with pytest.raises(OptionError, match=r"layout must be one of side-by-side, .* got 'sbs'"):
        read_views(tmp_path / "a.png", "sbs")
    with pytest.raises(FileError, match="no such file"):
        read_views(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(FileError, match="not an image"):
        read_views(tmp_path / "a.png", "side-by-side")
    path = tmp_path / "three.tiff"
    tifffile.imwrite(path, np.zeros((3, 20, 30), np.uint8), photometric="minisblack")
    with pytest.raises(FileError, match="must hold two pictures, got 3"):
        read_views(path)
    path = tmp_path / "unlike.tiff"
    with tifffile.TiffWriter(path) as writer:
        writer.write(np.zeros((20, 30), np.uint8))
        writer.write(np.zeros((20, 31), np.uint8))
    with pytest.raises(FileError, match="must have one size, got 30x20 and 31x20"):
        read_views(path)
    for width in (0, 3):
        with pytest.raises(OptionError, match=f"even width, got {width}"):
            split_views(np.zeros((4, width)), "side-by-side")


def test_damaged_indices_of_an_mpo_are_no_pair(tmp_path):
    """Cut, or of lengths that lead nowhere: the first picture alone is left, which is too narrow for two views."""
    images = pair()
    good = mpo(images)
    path = tmp_path / "a.mpo"
    for data in (good[:60], mpo(images, lengths=0), mpo(images, lengths=16), mpo(images, lengths=0xFFFFFFF0)):
        path.write_bytes(data)
        with pytest.raises(FileError):
            read_views(path)
    rng = np.random.default_rng(1)
    for _ in range(200):
        data = bytearray(good)
        for place in rng.integers(2, 120, 3):
            data[place] = rng.integers(0, 256)
        path.write_bytes(data)
        try:
            left, right = read_views(path)
        except FileError:
            continue
        assert left.shape == right.shape
