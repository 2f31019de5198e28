"""Files: every format is checked against bytes laid out by hand, and bad input against its one line."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereokit import io
from stereokit.errors import FileError, InputError, OptionError

DATA = Path(os.environ.get("STEREOKIT_DATA", Path(__file__).parents[3] / "shared" / "data"))
NAN, INF = np.nan, np.inf


def png(path, rows, depth, color_type, palette=None):
    """Write a PNG with the standard library only; `rows` are the raw bytes of each row."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    width = len(rows[0]) * 8 // (depth * {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[color_type])
    head = struct.pack(">IIBBBBB", width, len(rows), depth, color_type, 0, 0, 0)
    body = zlib.compress(b"".join(b"\0" + row for row in rows))
    colors = chunk(b"PLTE", palette) if palette else b""
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + colors + chunk(b"IDAT", body) + chunk(b"IEND", b""))


def test_read_image_gives_rgb_and_drops_alpha(tmp_path):
    png(tmp_path / "rgb.png", [bytes([255, 0, 0, 1, 2, 3])], 8, 2)
    png(tmp_path / "rgba.png", [bytes([255, 0, 0, 9, 1, 2, 3, 9])], 8, 6)
    for name in ("rgb.png", "rgba.png"):
        image = io.read_image(tmp_path / name)
        assert image.dtype == np.uint8
        assert image.flags.c_contiguous
        assert image.tolist() == [[[255, 0, 0], [1, 2, 3]]]


def test_read_image_resolves_palettes(tmp_path):
    png(tmp_path / "palette.png", [bytes([1, 0])], 8, 3, palette=bytes([10, 20, 30, 40, 50, 60]))
    assert io.read_image(tmp_path / "palette.png").tolist() == [[[40, 50, 60], [10, 20, 30]]]


def test_read_image_keeps_16_bits(tmp_path):
    png(tmp_path / "deep.png", [struct.pack(">3H", 1, 256, 65535)], 16, 0)
    image = io.read_image(tmp_path / "deep.png")
    assert image.dtype == np.uint16
    assert image.tolist() == [[1, 256, 65535]]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_gray_is_weighted_rgb(tmp_path, dtype):
    image = np.array([[[200, 100, 50], [0, 0, 0], [30, 30, 30]]], dtype)
    io.write_image(tmp_path / "a.tiff", image)
    expected = np.array([[0.299 * 200 + 0.587 * 100 + 0.114 * 50, 0, 30]])  # 124.2
    gray = io.read_image(tmp_path / "a.tiff", gray=True)
    assert gray.dtype == dtype
    assert np.allclose(gray, expected, atol=0.5 if np.issubdtype(dtype, np.integer) else 1e-4)
    io.write_image(tmp_path / "b.tiff", image[..., 0])
    assert np.array_equal(io.read_image(tmp_path / "b.tiff", gray=True), image[..., 0])


@pytest.mark.parametrize("name", ["missing.png", "text.png", "empty.png", "cut.png", "folder.png"])
def test_read_image_refuses_what_is_no_image(tmp_path, name):
    (tmp_path / "text.png").write_text("hello\n" * 20)
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "cut.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0")
    with pytest.raises(FileError, match=name) as caught:
        io.read_image(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", io.IMAGE_SUFFIXES)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_write_image_keeps_the_type_or_refuses(tmp_path, suffix, dtype):
    image = (np.arange(7 * 5 * 3).reshape(7, 5, 3) * 2).astype(dtype)
    path = tmp_path / f"a{suffix.upper()}"
    if suffix == ".pgm":  # grey by definition
        image = image[:, :, 0]
    try:
        io.write_image(path, image[::-1, ::-1])
    except InputError as error:
        assert dtype != np.uint8
        assert str(np.dtype(dtype)) in str(error)
        assert not any(tmp_path.iterdir())
        return
    back = io.read_image(path)
    assert back.dtype == dtype
    if not suffix.startswith(".j"):
        assert np.array_equal(back, image[::-1, ::-1])


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((2, 2), np.int32),
        np.zeros((2, 2, 4), np.uint8),
        np.zeros(4, np.uint8),
        np.zeros((0, 3), np.uint8),
    ],
)
def test_write_image_refuses_other_arrays(tmp_path, array):
    with pytest.raises(InputError, match="array must be"):
        io.write_image(tmp_path / "a.png", array)
    assert not any(tmp_path.iterdir())


def test_pgm_is_grey_and_ppm_is_colour(tmp_path):
    with pytest.raises(InputError, match=r"\.pgm must be \(H, W\), got \(2, 2, 3\)"):
        io.write_image(tmp_path / "a.pgm", np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(InputError, match=r"\.ppm must be \(H, W, 3\), got \(2, 2\)"):
        io.write_image(tmp_path / "a.ppm", np.zeros((2, 2), np.uint8))
    assert not any(tmp_path.iterdir())


def test_kitti_png_is_read_as_the_devkit_says(tmp_path):
    png(
        tmp_path / "d.png",
        [struct.pack(">4H", 0, 1, 256, 65535), struct.pack(">4H", 384, 0, 25600, 2)],
        16,
        0,
    )
    expected = np.array([[NAN, 1 / 256, 1, 65535 / 256], [1.5, NAN, 100, 2 / 256]], np.float32)
    disparity = io.read_disparity(tmp_path / "d.png")
    assert disparity.dtype == np.float32
    np.testing.assert_array_equal(disparity, expected)


def test_kitti_png_is_written_as_the_devkit_says(tmp_path):
    disparity = np.array([[NAN, INF, 0, 1e-6, 1.5, 255.99, 256, 1e6, 2 + 0.6 / 256]], np.float32)
    io.write_disparity(tmp_path / "d.png", disparity, clip=True)
    stored = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    assert stored.tolist() == [[0, 0, 1, 1, 384, 65533, 65535, 65535, 513]]


def test_kitti_png_holds_no_negative_disparity(tmp_path):
    with pytest.raises(InputError, match=r"disparity must not be negative .* got -0.25"):
        io.write_disparity(tmp_path / "d.png", np.array([[1, -0.25, NAN]], np.float32))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["eight", "color"])
def test_png_that_is_no_kitti_map_is_refused(tmp_path, kind):
    shape, dtype = ((2, 3), np.uint8) if kind == "eight" else ((2, 3, 3), np.uint16)
    io.write_image(tmp_path / "d.png", np.ones(shape, dtype))
    with pytest.raises(FileError, match="16-bit grey PNG"):
        io.read_disparity(tmp_path / "d.png")


@pytest.mark.parametrize("header", [b"Pf\n3 2\n%s\n", b"Pf \n3 2 \n%s\n", b"Pf 3 2 %s ", b"Pf\r\n3 2\r\n%s\r\n"])
@pytest.mark.parametrize(("scale", "order"), [(b"-1.0", "<"), (b"1", ">"), (b"-0.003922", "<"), (b"2.5e-1", ">")])
def test_pfm_is_bottom_up_in_the_order_of_its_scale(tmp_path, header, scale, order):
    rows = struct.pack(f"{order}6f", 4, 5, INF, 1, -2, NAN)  # the bottom row first
    (tmp_path / "d.pfm").write_bytes(header % scale + rows)
    np.testing.assert_array_equal(io.read_disparity(tmp_path / "d.pfm"), [[1, -2, NAN], [4, 5, NAN]])


def test_pfm_is_written_byte_by_byte(tmp_path):
    io.write_disparity(tmp_path / "d.pfm", np.array([[1, NAN], [3, -4]], np.float64))
    assert (tmp_path / "d.pfm").read_bytes() == b"Pf\n2 2\n-1.0\n" + struct.pack("<4f", 3, -4, 1, INF)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no PFM header"),
        (b"P5\n2 2\n255\n0000", "no PFM header"),
        (b"PF\n1 1\n-1\n" + bytes(12), "colour"),
        (b"Pf\n2 2\n-1\n" + bytes(15), "15 bytes of data where 16"),
        (b"Pf\n2 2\n0\n" + bytes(16), "scale 0"),
        (b"Pf\n0 2\n-1\n", "size 0x2"),
        (b"Pf\n1 1\n-1.2.3\n" + bytes(4), "broken"),
    ],
)
def test_broken_pfm_is_refused(tmp_path, content, message):
    (tmp_path / "d.pfm").write_bytes(content)
    with pytest.raises(FileError, match=message):
        io.read_disparity(tmp_path / "d.pfm")


@pytest.mark.parametrize("suffix", [".pfm", ".npy", ".tiff", ".tif", ".TIFF"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (7, 5)])
def test_float_formats_round_trip(tmp_path, suffix, shape):
    disparity = np.random.default_rng(0).normal(0, 100, (2 * shape[0], 3 * shape[1])).astype(np.float32)
    disparity = disparity[::2, ::3]  # strided
    disparity[0, 0] = NAN
    original = disparity.copy()
    io.write_disparity(tmp_path / f"d{suffix}", disparity)
    np.testing.assert_array_equal(disparity, original)
    back = io.read_disparity(tmp_path / f"d{suffix}")
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, disparity)


def test_npy_of_other_numbers_is_cast_and_objects_are_refused(tmp_path):
    np.save(tmp_path / "d.npy", np.array([[1, 2]], np.int16))
    np.testing.assert_array_equal(io.read_disparity(tmp_path / "d.npy"), np.array([[1, 2]], np.float32))
    np.save(tmp_path / "d.npy", np.array([[1, INF, -INF]]))
    np.testing.assert_array_equal(io.read_disparity(tmp_path / "d.npy"), [[1, NAN, NAN]])
    for array in (np.ones(3), np.ones((2, 2), bool), np.ones((1, 1), complex), np.array([[{}]], object)):
        np.save(tmp_path / "d.npy", array, allow_pickle=True)
        with pytest.raises(FileError, match=r"d\.npy"):
            io.read_disparity(tmp_path / "d.npy")
    (tmp_path / "d.npy").write_bytes(b"")
    with pytest.raises(FileError, match="not a readable npy"):
        io.read_disparity(tmp_path / "d.npy")


@pytest.mark.parametrize("call", [io.read_disparity, lambda p: io.write_disparity(p, np.ones((2, 2), np.float32))])
def test_unknown_suffix_names_the_known_ones(tmp_path, call):
    with pytest.raises(FileError, match=r"\.png, \.pfm, \.npy, \.tiff, got .*d\.jpg"):
        call(tmp_path / "d.jpg")


@pytest.mark.parametrize("array", [np.ones(3, np.float32), np.ones((2, 2), int), np.ones((0, 2)), [[None]]])
def test_write_disparity_refuses_other_arrays(tmp_path, array):
    with pytest.raises(InputError, match="disparity must be"):
        io.write_disparity(tmp_path / "d.pfm", array)


def test_missing_folder_and_folder_as_target_are_clear(tmp_path):
    with pytest.raises(FileError, match=r"the folder .*nowhere.* does not exist"):
        io.write_disparity(tmp_path / "nowhere" / "d.pfm", np.ones((2, 2), np.float32))
    (tmp_path / "d.pfm").mkdir()
    with pytest.raises(FileError, match=r"cannot write .*d\.pfm"):
        io.write_disparity(tmp_path / "d.pfm", np.ones((2, 2), np.float32))
    with pytest.raises(FileError, match="is a folder"):
        io.check_output(tmp_path / "d.pfm")
    assert [path.name for path in tmp_path.iterdir()] == ["d.pfm"]


@pytest.mark.parametrize("failing", ["replace", "write"])
def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, failing):
    def fail(*_):
        raise OSError(28, "No space left on device")

    path = tmp_path / "d.npy"
    io.write_disparity(path, np.ones((2, 2), np.float32))
    before = path.read_bytes()
    if failing == "replace":
        monkeypatch.setattr(os, "replace", fail)
    else:
        monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(FileError, match="No space left"):
        io.write_disparity(path, np.zeros((3, 3), np.float32))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", io.IMAGE_SUFFIXES)
def test_writing_prints_nothing(tmp_path, capfd, suffix):
    shape = (4, 4, 3) if suffix == ".ppm" else (4, 4)
    io.write_image(tmp_path / f"a{suffix}", np.zeros(shape, np.uint8))
    io.read_image(tmp_path / f"a{suffix}")
    assert capfd.readouterr() == ("", "")


def test_written_files_have_ordinary_rights(tmp_path):
    (tmp_path / "plain").write_bytes(b"")
    io.write_bytes(tmp_path / "ours", b"x")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_opencv_fixed_point_by_hand():
    fixed = np.array([[-16, 0, 1, 16, 24, 32767]], np.int16)
    disparity = io.from_opencv(fixed)
    assert disparity.dtype == np.float32
    np.testing.assert_array_equal(disparity, [[NAN, 0, 1 / 16, 1, 1.5, 32767 / 16]])
    np.testing.assert_array_equal(io.to_opencv(disparity), fixed)
    np.testing.assert_array_equal(io.from_opencv(np.array([[-176, -160]], np.int16), -10), [[NAN, -10]])
    assert io.to_opencv(np.array([[NAN, -10.0]]), -10).tolist() == [[-176, -160]]


def test_opencv_fixed_point_agrees_with_the_matcher():
    rng = np.random.default_rng(3)
    left = rng.integers(0, 256, (40, 80), np.uint8)
    fixed = cv2.StereoSGBM.create(minDisparity=2, numDisparities=16, blockSize=5).compute(left, np.roll(left, -5, 1))
    disparity = io.from_opencv(fixed, 2)
    assert np.isnan(disparity).any()
    assert np.median(disparity[np.isfinite(disparity)]) == 5
    np.testing.assert_array_equal(io.to_opencv(disparity, 2), fixed)


def test_opencv_fixed_point_refuses_what_it_cannot_say():
    with pytest.raises(InputError, match="int16"):
        io.from_opencv(np.zeros((2, 2), np.float32))
    for value in (-1.0, 2048.0):
        with pytest.raises(InputError, match="above -1 and below 2048"):
            io.to_opencv(np.array([[value]]))
    with pytest.raises(OptionError, match="min_disparity"):
        io.to_opencv(np.array([[1.0]]), -2048)
    with pytest.raises(OptionError, match="min_disparity"):
        io.from_opencv(np.zeros((1, 1), np.int16), 5000)


def test_ply_byte_by_byte(tmp_path):
    points = np.array([[1, 2, 3], [-1, 0.5, 4]], np.float64)
    io.write_ply(tmp_path / "a.ply", points, np.array([[1, 2, 3], [255, 0, 7]], np.uint8))
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    xyz = b"property float x\nproperty float y\nproperty float z\n"
    rgb = b"property uchar red\nproperty uchar green\nproperty uchar blue\n"
    body = struct.pack("<3f3B3f3B", 1, 2, 3, 1, 2, 3, -1, 0.5, 4, 255, 0, 7)
    assert (tmp_path / "a.ply").read_bytes() == head + xyz + rgb + b"end_header\n" + body
    io.write_ply(tmp_path / "b.ply", points)
    body = struct.pack("<6f", 1, 2, 3, -1, 0.5, 4)
    assert (tmp_path / "b.ply").read_bytes() == head + xyz + b"end_header\n" + body
    io.write_ply(tmp_path / "c.ply", np.empty((0, 3), np.float32))
    assert b"element vertex 0" in (tmp_path / "c.ply").read_bytes()


def test_ply_refuses_bad_clouds(tmp_path):
    good = np.ones((2, 3), np.float32)
    with pytest.raises(InputError, match="points must be"):
        io.write_ply(tmp_path / "a.ply", good[0])
    with pytest.raises(InputError, match="finite"):
        io.write_ply(tmp_path / "a.ply", good * NAN)
    with pytest.raises(InputError, match="colors must be"):
        io.write_ply(tmp_path / "a.ply", good, np.ones((2, 3)))
    with pytest.raises(FileError, match=r"\.ply"):
        io.write_ply(tmp_path / "a.obj", good)
    assert not any(tmp_path.iterdir())


@pytest.mark.data
def test_real_files():
    if not DATA.is_dir():
        pytest.skip(f"no real pairs in {DATA}; set STEREOKIT_DATA")
    truth = io.read_disparity(DATA / "kitti2015/training/disp_noc_0/000000_10.png")
    assert truth.shape == (375, 1242)
    assert 0.1 < np.isfinite(truth).mean() < 0.3  # lidar is sparse
    assert 1 < np.nanmin(truth) < np.nanmax(truth) < 230
    motorcycle = io.read_disparity(DATA / "middlebury/2014/Motorcycle/disp0GT.pfm")
    assert motorcycle.shape == (497, 741)
    assert 7 < np.nanmin(motorcycle) < np.nanmax(motorcycle) < 65  # vmin and vmax of its calib.txt
    assert io.read_disparity(DATA / "sceneflow/disparity/left/dmb_0.pfm").shape == (540, 960)
    assert io.read_image(DATA / "kitti2015/training/image_2/000000_10.png").shape == (375, 1242, 3)
    assert io.read_image(DATA / "kitti2012/training/image_0/000070_10.png").ndim == 2
