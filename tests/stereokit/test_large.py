"""Matching in windows: where the map must be that of the whole image, how far seams may be off, and how much memory."""

from __future__ import annotations

import json
import sys
import tracemalloc

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

import stereokit
from stereokit.cli import app
from stereokit.errors import FileError, InputError, OptionError, StereokitError
from stereokit.large import matching, memory
from stereokit.large.output import write_bands
from stereokit.large.plan import STEP, plan
from stereokit.large.sources import open_source

METHODS = ("S1", "S2", "S3", "S4")


def textured(height, width, seed=0, shift=6, channels=None):
    """Return a pair of smooth noise, the right view shifted, noise of its own on top."""
    rng = np.random.default_rng(seed)
    shape = (height, width) if channels is None else (height, width, channels)
    left = cv2.GaussianBlur(rng.integers(0, 256, shape, dtype=np.uint8), (0, 0), 1.2)
    right = np.roll(left, -shift, axis=1)
    noise = rng.integers(0, 12, shape, dtype=np.uint8)
    return left, cv2.add(right, noise)


@pytest.fixture
def cut(monkeypatch):
    """Return a function that lets windows have so many pixels, whatever memory they take."""

    def limit(pixels):
        def by_pixels(height, width, reach_y, reach_x, available, needed):
            return plan(height, width, reach_y, reach_x, pixels, lambda h, w: h * w)

        monkeypatch.setattr(matching, "plan", by_pixels)

    return limit


def marked(pair, value, hot=False):
    """Return copies of a pair with a band of `value` each and, if asked for, some outliers of different values."""
    left, right = pair[0].copy(), pair[1].copy()
    left[:, 20:26], right[60:64] = value, value
    if hot:
        left[::20, ::20] = np.arange(32).reshape(4, 8) * 1000 + 9000
    return left, right


def kinds():
    left, right = textured(70, 160)
    rgb = textured(70, 160, channels=3)
    wide = left.astype(np.uint16) * 31 + 700, right.astype(np.uint16) * 31 + 600
    real = left.astype(np.float32) / 97 - 1, right.astype(np.float32) / 97 - 1
    holes = real[0].copy(), real[1].copy()
    holes[0][10:20, 30:50] = np.nan
    holes[1][40] = np.inf
    whole_holes = left.astype(np.float32), right.astype(np.float32)
    whole_holes[0][5:9, 60:70] = np.nan
    return {
        "grey": (left, right),
        "rgb": rgb,
        "mixed": (rgb[0], right),
        "uint16": wide,
        "uint16 of 8 bits": (left.astype(np.uint16), right.astype(np.uint16)),
        "uint16 rgb": (rgb[0].astype(np.uint16) * 200, rgb[1].astype(np.uint16) * 200),
        "whole floats": (left.astype(np.float64), right.astype(np.float64)),
        "whole floats of 16 bits": (wide[0].astype(np.float32), wide[1].astype(np.float32)),
        "floats": real,
        "float rgb": (rgb[0] / np.float64(91), rgb[1] / np.float64(91)),
        "floats with holes": holes,
        "whole floats with holes": whole_holes,
        "floats with a mark": marked(real, -9999),
        "uint16 with a mark and outliers": marked(wide, 65535, hot=True),
        "floats with outliers": marked(real, 300.0, hot=True),
        "int16 with a mark": marked((left.astype(np.int16), right.astype(np.int16)), -32768),
        "rows without evidence": (np.where(np.arange(70)[:, None] == 9, np.nan, real[0] + 1000), real[1] + 1000.0),
        "rgba": tuple(np.dstack([image, 255 * (image[..., :1] > 40)]) for image in rgb),
        "float16": (real[0].astype(np.float16), real[1].astype(np.float16)),
        "blank": (np.full((40, 50), 0.5), np.full((40, 50), 0.5)),
    }


@pytest.mark.parametrize("kind", kinds())
@pytest.mark.parametrize("method", ["S2", "S3"])
def test_one_window_gives_the_map_of_match(kind, method, tmp_path):
    left, right = kinds()[kind]
    stereokit.match_large(left, right, tmp_path / "out.npy", method, max_disparity=16)
    expected = stereokit.match(left, right, method, max_disparity=16)
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), expected)


def test_nodata_is_that_of_match(tmp_path):
    left, right = textured(70, 160)
    left[:, 20:26] = 0
    stereokit.match_large(left, right, tmp_path / "out.npy", "S2", max_disparity=16, nodata=0, fill=None)
    expected = stereokit.match(left, right, "S2", max_disparity=16, nodata=0, fill=None)
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), expected)
    assert np.isnan(expected[:, 20:26]).all()


@pytest.mark.parametrize("kind", ["grey", "uint16", "floats", "floats with a mark", "floats with outliers"])
def test_windows_decide_what_whole_images_decide(kind, tmp_path, cut):
    """The domain transform forgets within the margin: strips must give the same map, bit for bit, for any type."""
    left, right = kinds()[kind]
    left, right = (np.vstack([image] * 4) for image in (left, right))
    left[:, :9] //= 1 if kind.startswith("floats") else 3  # ranges of windows differ
    cut(220 * 160)
    for method in ("S1", "S3"):
        result = stereokit.match_large(left, right, tmp_path / "out.npy", method, max_disparity=16, overlap=80)
        assert result.windows > 1 and result.window[1] == 160
        expected = stereokit.match(left, right, method, max_disparity=16)
        np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), expected)


@pytest.mark.parametrize(
    "options", [{"fill": None}, {"fill": "background", "median": 3}, {"median": 0}, {"speckle": 0}]
)
def test_options_of_the_finish_are_those_of_match(options, tmp_path, cut):
    left, right = textured(280, 160)
    left[100:190, 20:150] = 90  # a gap wider than a window's margin
    matcher_options = {"max_disparity": 16, **options}
    cut(220 * 160)
    result = stereokit.match_large(left, right, tmp_path / "out.npy", "S1", overlap=80, **matcher_options)
    assert result.windows > 1
    expected = stereokit.Matcher("S1", **matcher_options)(left, right)
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), expected.disparity)
    assert result.density == pytest.approx(expected.density)


def seam_error(tmp_path, left, right, method, overlap, **options):
    """Return shares of pixels that differ at all and by more than a pixel, and the result."""
    out = tmp_path / "out.npy"
    result = stereokit.match_large(left, right, out, method, overlap=overlap, **options)
    error = np.abs(np.load(out) - stereokit.match(left, right, method, **options))
    return (error > 0).mean(), (error > 1).mean(), result


@pytest.mark.parametrize("method", METHODS)
def test_seams_fade_with_the_overlap(method, tmp_path, cut):
    pytest.importorskip("skimage")
    from stereokit_evaluation.synthetic.scenes import generate

    scene = generate(3, 400, 704, 64)
    differences = {}
    for overlap in (0, 32, 96):
        cut(400 * (352 + overlap))  # two strips
        differ, far, result = seam_error(tmp_path, scene.left, scene.right, method, overlap, max_disparity=64)
        assert result.windows == 2 and result.window == (352 + overlap, 400)
        differences[overlap] = 704 * differ, 704 * far  # pixels for each column of the cut
    assert differences[0] > differences[32] >= differences[96]
    assert differences[96][0] < 2 and differences[96][1] < 0.1
    if method in ("S1", "S3"):
        assert differences[96][0] == 0


def test_columns_are_cut_where_a_strip_is_too_wide(tmp_path, cut):
    left, right = textured(300, 1200)
    cut(300 * 600)
    differ, far, result = seam_error(tmp_path, left, right, "S2", 48, max_disparity=16)
    assert result.window[1] < 1200 and result.windows > 2
    assert differ < 0.01 and far < 0.001


def test_half_size_keeps_its_phase(tmp_path, cut):
    left, right = textured(331, 161)
    cut(250 * 161)
    differ, far, result = seam_error(tmp_path, left, right, "S1", 96, max_disparity=16, scale=0.5)
    assert result.windows > 1
    assert far == 0 and differ < 0.001


@pytest.mark.parametrize(
    ("method", "options"),
    [("S2", {}), ("S2", {"median": 0}), ("S2", {"median": 3, "fill": None}), ("S4", {}), ("S4", {"smooth": 0})],
)
def test_windows_search_where_the_whole_image_does(method, options, tmp_path, cut):
    """Windows are matched without median and fill: their half-size maps have both, and the range of the image."""
    left, right = textured(481, 403)
    tiles = np.random.default_rng(4).integers(0, 60, (17, 15))
    shifts = np.kron(tiles, np.ones((29, 27), int))[:481, :403]  # steps everywhere, and what is hidden behind them
    right = np.take_along_axis(right, np.clip(np.arange(403) + shifts, 0, 402), axis=1)
    cut(320 * 403)
    options = {"search": "coarse-to-fine", "max_disparity": 128, **options}
    result = stereokit.match_large(left, right, tmp_path / "out.npy", method, overlap=96, **options)
    assert result.windows > 1 and result.window[1] == 403
    expected = stereokit.Matcher(method, **options)(left, right).disparity
    windows = np.load(tmp_path / "out.npy")
    same = (windows == expected) | (np.isnan(windows) & np.isnan(expected))
    assert same.mean() > 0.995


# Windows


@given(
    st.integers(1, 900), st.integers(1, 900), st.integers(0, 70), st.integers(0, 70), st.integers(20_000, 400_000)
)  # fmt: skip
def test_the_cut_a_plan_cover_each_pixel_once(height, width, reach_y, reach_x, budget):
    try:
        windows = plan(height, width, reach_y, reach_x, budget, lambda h, w: h * w)
    except OptionError:
        assert min(height, 2 * reach_y + STEP) * min(width, 2 * reach_x + STEP) > budget * 0.5
        return
    assert windows.window[0] * windows.window[1] <= budget
    for cuts, length, reach in ((windows.rows, height, reach_y), (windows.columns, width, reach_x)):
        assert [cut.first for cut in cuts] == [0, *(cut.last for cut in cuts[:-1])]
        assert cuts[-1].last == length and len({cut.stop - cut.start for cut in cuts}) == 1
        for cut in cuts:
            assert 0 <= cut.start <= cut.first < cut.last <= cut.stop <= length and cut.start % STEP == 0
            assert cut.start == 0 or cut.first - cut.start >= reach
            assert cut.stop == length or cut.stop - cut.last >= reach


@pytest.mark.parametrize(
    ("amount", "expected"),
    [("2GB", 2 * 10**9), ("1.5 GiB", 3 * 2**29), ("800m", 8 * 10**8), ("64k", 64_000), (12345, 12345), ("7", 7)],
)
def test_memory_is_read_with_its_unit(amount, expected):
    assert memory.parse_memory(amount) == expected


@pytest.mark.parametrize("amount", ["", "two", "-1GB", "1XB", 0, -5, True, float("nan"), float("inf"), None, []])
def test_other_memory_is_refused(amount):
    with pytest.raises(OptionError, match="memory must be"):
        memory.parse_memory(amount)


# Files


def test_mapped_arrays_of_any_order(tmp_path):
    image = np.random.default_rng(0).integers(0, 60000, (50, 40), dtype=np.uint16)
    for name, stored in (("c", image), ("f", np.asfortranarray(image)), ("big", image.astype(">u2"))):
        np.save(tmp_path / f"{name}.npy", stored)
        source = open_source("left", tmp_path / f"{name}.npy")
        assert source.shape == (50, 40) and source.dtype == np.uint16
        np.testing.assert_array_equal(source.read(7, 31, 3, 40), image[7:31, 3:40])


@pytest.mark.parametrize(
    "layout",
    [
        {"tile": (32, 48)},
        {"tile": (32, 48), "compression": "deflate"},
        {"tile": (64, 16), "compression": "lzw", "predictor": True},
        {"rowsperstrip": 7},
        {"rowsperstrip": 7, "compression": "lzw"},
        {"tile": (32, 48), "bigtiff": True},
        {"tile": (32, 48), "byteorder": ">"},
    ],
)
@pytest.mark.parametrize("shape", [(100, 90), (100, 90, 3), (100, 90, 4)])
def test_tiff_is_read_by_windows(layout, shape, tmp_path):
    tifffile = pytest.importorskip("tifffile", reason="windows of TIFF need the extra 'large'")
    if layout.get("compression") == "lzw":
        pytest.importorskip("imagecodecs", reason="LZW needs the extra 'large'")
    image = np.random.default_rng(0).integers(0, 60000, shape, dtype=np.uint16)
    photometric = "minisblack" if len(shape) == 2 else "rgb"
    tifffile.imwrite(tmp_path / "a.tif", image, photometric=photometric, **layout)
    source = open_source("left", tmp_path / "a.tif")
    assert source.shape[:2] == (100, 90)
    expected = image if image.ndim == 2 else image[:, :, :3]
    for y0, y1, x0, x1 in ((0, 100, 0, 90), (31, 33, 47, 49), (99, 100, 89, 90), (5, 70, 50, 80)):
        np.testing.assert_array_equal(source.read(y0, y1, x0, x1), expected[y0:y1, x0:x1])


def test_tiff_is_written_in_tiles(tmp_path):
    tifffile = pytest.importorskip("tifffile", reason="tiled TIFF needs the extra 'large'")
    left, right = textured(300, 290)
    result = stereokit.match_large(left, right, tmp_path / "out.tiff", "S2", max_disparity=16, fill=None)
    assert result.output == tmp_path / "out.tiff" and 0 < result.density < 1
    expected = stereokit.match(left, right, "S2", max_disparity=16, fill=None)
    np.testing.assert_array_equal(stereokit.read_disparity(tmp_path / "out.tiff"), expected)
    with tifffile.TiffFile(tmp_path / "out.tiff") as file:
        assert file.pages.first.is_tiled


def test_bands_of_any_height_make_one_file(tmp_path):
    whole = np.random.default_rng(0).random((700, 300), np.float32)
    for suffix in (".npy", ".tiff"):
        if suffix == ".tiff":
            pytest.importorskip("tifffile", reason="tiled TIFF needs the extra 'large'")
        bands = (whole[a:b] for a, b in ((0, 1), (1, 258), (258, 600), (600, 700)))
        write_bands(tmp_path / f"out{suffix}", 700, 300, bands)
        np.testing.assert_array_equal(stereokit.read_disparity(tmp_path / f"out{suffix}"), whole)


def test_other_files_are_read_whole(tmp_path):
    left, right = textured(40, 60)
    stereokit.io.write_image(tmp_path / "l.png", left)
    stereokit.io.write_image(tmp_path / "r.png", right)
    stereokit.match_large(tmp_path / "l.png", tmp_path / "r.png", tmp_path / "o.npy", "S2", max_disparity=16)
    np.testing.assert_array_equal(np.load(tmp_path / "o.npy"), stereokit.match(left, right, "S2", max_disparity=16))


# What is refused, and what is left behind


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"output": "out.png"}, FileError, "output must end in one of .npy, .tiff, .tif"),
        ({"output": "no/out.npy"}, FileError, "does not exist"),
        ({"right": np.zeros((20, 31), np.uint8)}, InputError, "same size"),
        ({"right": np.zeros((20, 30), np.uint16)}, InputError, "same type"),
        ({"left": np.zeros((20, 30), complex)}, InputError, "left must be of whole or floating-point numbers"),
        ({"left": "none.npy"}, FileError, "no such file"),
        ({"left": "broken.npy"}, FileError, "not a readable npy file"),
        ({"left": "short.npy"}, FileError, "not a readable npy file"),
        ({"overlap": -1}, OptionError, "overlap must be from 0"),
        ({"memory": 1000}, OptionError, "the smallest needs"),
        ({"options": {"confidence": True}}, OptionError, "confidence is not available"),
        ({"options": {"p9": 1}}, OptionError, "p9"),
    ],
)
def test_bad_input_ends_in_one_line_and_no_file(change, error, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.npy").write_bytes(b"nonsense")
    np.save("short.npy", np.zeros((20, 30), np.uint8))
    (tmp_path / "short.npy").write_bytes((tmp_path / "short.npy").read_bytes()[:-100])
    before = sorted(tmp_path.iterdir())
    call = {"left": np.zeros((20, 30), np.uint8), "right": np.zeros((20, 30), np.uint8), "output": "out.npy", **change}
    options = call.pop("options", {})
    with pytest.raises(error, match=words) as raised:
        stereokit.match_large(**call, method="S2", max_disparity=16, **options)
    assert len(str(raised.value).splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"nonsense", "not a readable TIFF"), (b"", "not a readable TIFF"), ("cut", "not a readable TIFF"),
     ("header", "without an image"), ("missing", "no such file")],
)  # fmt: skip
def test_broken_tiff_is_refused(content, words, tmp_path):
    tifffile = pytest.importorskip("tifffile", reason="windows of TIFF need the extra 'large'")
    path = tmp_path / "a.tif"
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content == "cut":
        tifffile.imwrite(path, image, tile=(16, 16), compression="deflate", photometric="rgb")
        data = bytearray(path.read_bytes())
        with tifffile.TiffFile(path) as file:
            offset = file.pages.first.dataoffsets[3]
        data[offset : offset + 20] = b"x" * 20
        path.write_bytes(data)
    elif content == "header":
        path.write_bytes(b"II*\0\x08\0\0\0")
    with pytest.raises(FileError, match=words):
        stereokit.match_large(path, path, tmp_path / "out.npy", "S2", max_disparity=16)
    assert not (tmp_path / "out.npy").exists()


def test_tiff_without_its_package_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tifffile", None)
    image = np.zeros((20, 30), np.uint8)
    with pytest.raises(StereokitError, match=r"stereokit\[tiff\]"):
        stereokit.match_large(image, image, tmp_path / "out.tif", "S2")
    (tmp_path / "a.tif").write_bytes(b"II*\0")
    with pytest.raises(StereokitError, match=r"stereokit\[tiff\]"):
        stereokit.match_large(tmp_path / "a.tif", image, tmp_path / "out.npy", "S2")


def test_an_interrupt_leaves_nothing(tmp_path, cut):
    left, right = textured(280, 160)
    (tmp_path / "out.npy").write_bytes(b"older")

    cut(220 * 160)

    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stereokit.match_large(left, right, tmp_path / "out.npy", "S1", max_disparity=16, overlap=64, progress=stop)
    assert [path.name for path in tmp_path.iterdir()] == ["out.npy"]
    assert (tmp_path / "out.npy").read_bytes() == b"older"


# Memory


@pytest.mark.parametrize(("method", "levels"), [("S2", 64), ("S2", 256), ("S3", 64)])
def test_what_is_allocated_stays_below_the_bound(method, levels, tmp_path, monkeypatch):
    """Counted by the allocator of arrays, above what the process is said to hold already."""
    left, right = textured(900, 700, channels=3)
    for name, image in (("l", left), ("r", right)):
        np.save(tmp_path / f"{name}.npy", image)
    paths = [tmp_path / f"{name}.npy" for name in ("l", "r", "out")]
    options = {"max_disparity": levels, "threads": 1, "overlap": 32}
    stereokit.match(left[:64], right[:64], method, max_disparity=levels)  # compiles, which allocates too
    before, bound = 10**8, 1.6 * 10**8
    monkeypatch.setattr(matching, "resident_nbytes", lambda: before)
    tracemalloc.start()
    try:
        result = stereokit.match_large(*paths, method, memory=bound, **options)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert result.windows > 1
    arrays = bound - before - 2**24  # the rest is for the interpreter and the system
    assert arrays / 4 < peak <= arrays


# The command


def test_the_command_matches_in_windows(tmp_path, monkeypatch, run_python):
    monkeypatch.chdir(tmp_path)
    left, right = textured(60, 100)
    np.save("l.npy", left)
    np.save("r.npy", right)
    words = ["match", "l.npy", "r.npy", "-o", "out.npy", "--method", "S2", "--max-disparity", "16"]
    # In a process of its own: the bound is that of all that a process occupies, and this one may hold more by now.
    run_python("-m", "stereokit.cli", *words, "--memory", "2GB", "--json", "out.json")
    np.testing.assert_array_equal(np.load("out.npy"), stereokit.match(left, right, "S2", max_disparity=16))
    report = json.loads((tmp_path / "out.json").read_text())
    assert report["windows"] == 1 and report["window"] == {"height": 60, "width": 100} and report["memory"] == "2GB"
    for extra in (["--color", "c.png"], ["--right", "r2.npy"], ["--memory", "much"]):
        refused = CliRunner().invoke(app.app, [*words, "--memory", "2GB", *extra])
        assert refused.exit_code == 2 and "error: " in refused.output
