"""Whatever a file holds: one `FileError` of one line, silent decoders, and the same image whatever reads it."""

from __future__ import annotations

import json
import os
import struct
import sys
import threading
import zlib

import cv2
import numpy as np
import pytest

from stereokit import io
from stereokit.calibration import read_calibration
from stereokit.errors import FileError, OptionError, one_line
from stereokit.io import quiet
from stereokit.large.memory import parse_memory
from stereokit.large.sources import open_source

IMAGE = np.random.default_rng(1).integers(0, 256, (24, 40), dtype=np.uint8)
COLOR = np.random.default_rng(2).integers(0, 256, (24, 40, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("raised", "words"),
    [
        (IndexError("0"), r"is not a readable thing \(0\)"),
        (KeyError(), r"is not a readable thing \(KeyError\)"),
        (ValueError("a\nb"), r"\(a b\)"),
        (RecursionError("maximum"), "nested too deeply"),
        (MemoryError(), "more memory than there is"),
        (FileNotFoundError(2, "none"), "no such file"),
        (PermissionError(13, "Permission denied"), "cannot read .*: Permission denied"),
        (OSError("odd"), r"not a readable thing \(odd\)"),
        (OptionError("fx must be positive, got 0"), "'a.b': fx must be positive, got 0"),
        (type("Foreign", (Exception,), {})("x" * 5000), "x{200}"),
    ],
)
def test_what_is_raised_while_parsing_becomes_one_line(raised, words):
    with pytest.raises(FileError, match=words) as caught, io.parsing("a.b", "thing"):
        raise raised
    assert len(str(caught.value).splitlines()) == 1 and len(str(caught.value)) < 300
    with pytest.raises(FileError, match=r"a rule, got 'a.b' \(why\)"), io.parsing("a.b", "thing", "a rule"):
        raise ValueError("why")


def test_a_file_error_and_an_interrupt_pass():
    for error in (FileError("as it is"), KeyboardInterrupt(), SystemExit(3)):
        with pytest.raises(type(error)) as caught, io.parsing("a.b", "thing"):
            raise error
        assert caught.value is error


def npy_with(header):
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(64)


HOSTILE = {
    "open.npy": npy_with(b"{'descr': '<f4', 'fortran_order': False, 'shape': (4, 4, \n"),
    "mapping.npy": npy_with(b"{}\n"),
    "huge.npy": npy_with(b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000, 1000000000), }\n"),
    "deep.npy": npy_with(b"(" * 60000 + b"\n"),
    "digits.npy": npy_with(b"{'descr': '<f4', 'fortran_order': False, 'shape': (" + b"1" * 5000 + b",), }\n"),
    "object.npy": npy_with(b"{'descr': '|O', 'fortran_order': False, 'shape': (1, 1), }\n"),
    "empty.npy": b"",
    "archive.npy": b"PK\3\4" + bytes(60),
    "pages.tif": b"II*\0\x08\0\0\0",
    "nowhere.tiff": b"II*\0\0\0\0\0",
    "big.tif": b"II+\0\x08\0\0\0\x10\0\0\0\0\0\0\0",
    "digits.pfm": b"Pf\n" + b"1" * 5000 + b" 1\n-1\n" + bytes(40),
    "claims.pfm": b"Pf\n1000000000 1000000000\n-1\n",
    "empty.png": b"",
    "text.png": b"hello",
    "cut.png": cv2.imencode(".png", COLOR)[1].tobytes()[:60],
    "cut.jpg": cv2.imencode(".jpg", COLOR)[1].tobytes()[:100],
    "cut.webp": cv2.imencode(".webp", COLOR)[1].tobytes()[:60],
}


def chunk(kind, content):
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def with_size(suffix):
    """Return a good image of 64 x 96 and the function that gives it another size, all else as it was."""
    grey = np.zeros((64, 96), np.uint8)
    data = cv2.imencode(suffix, grey if suffix in (".jpg", ".bmp") else np.dstack([grey] * 3))[1].tobytes()
    offset, layout = {
        ".png": (16, ">II"),
        ".gif": (6, "<HH"),
        ".bmp": (18, "<ii"),
        ".jpg": (data.find(b"\xff\xc0") + 5, ">HH"),
    }[suffix]

    def claiming(width, height):
        size = (height, width) if suffix == ".jpg" else (width, height)
        changed = bytearray(data)
        struct.pack_into(layout, changed, offset, *size)
        if suffix == ".png":
            changed[12:33] = chunk(b"IHDR", changed[16:29])[4:]
        return bytes(changed)

    return data, claiming


@pytest.mark.parametrize("suffix", [".png", ".gif", ".bmp", ".jpg"])
def test_a_small_file_that_claims_a_huge_image_never_reaches_the_decoder(suffix, tmp_path, monkeypatch):
    data, claiming = with_size(suffix)
    path = tmp_path / f"image{suffix}"
    path.write_bytes(data)
    assert io.read_image(path).shape[:2] == (64, 96)
    assert claiming(96, 64) == data
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    path.write_bytes(claiming(30000, 29000))
    for read in (io.read_image, lambda path: open_source("left", path)):
        with pytest.raises(FileError, match=rf"claims 30000x29000 pixels, more than {len(data)} bytes can hold"):
            read(path)


def test_a_chunk_that_claims_more_than_the_file_never_reaches_the_decoder(tmp_path, monkeypatch):
    path = tmp_path / "image.png"
    content = cv2.imencode(".png", IMAGE)[1].tobytes()
    offset = content.index(b"IDAT")
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    path.write_bytes(content[: offset - 4] + struct.pack(">I", 0x7FFFFFE3) + content[offset:])
    with pytest.raises(FileError, match=rf"a part of it claims more than its {len(content)} bytes"):
        io.read_image(path)


def test_a_segment_after_rubbish_still_tells_the_size_of_a_jpeg(tmp_path):
    path = tmp_path / "image.jpg"
    content = with_size(".jpg")[1](30000, 29000)
    path.write_bytes(content[:2] + b"rub\xff\x00bish\xff" + content[2:])
    with pytest.raises(FileError, match="claims 30000x29000"):
        io.read_image(path)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".jp2", ".webp"])
def test_blank_images_are_within_what_their_bytes_can_hold(suffix, tmp_path):
    path = tmp_path / f"image{suffix}"
    for shape in ((1500, 2000, 3), (1500, 2000)):
        if suffix == ".webp" and len(shape) == 2:
            continue  # it knows colour only
        path.write_bytes(cv2.imencode(suffix, np.full(shape, 7, np.uint8))[1].tobytes())
        assert io.read_image(path).shape == shape
    bits = struct.pack(">IIBBBBB", 8000, 6000, 1, 0, 0, 0, 0)  # one bit a pixel, packed as well as deflate can
    rows = zlib.compress(bytes(6000 * 1001), 9)
    path = tmp_path / "bits.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", bits) + chunk(b"IDAT", rows) + chunk(b"IEND", b""))
    assert io.read_image(path).shape == (6000, 8000)


@pytest.mark.parametrize("missing", [256, 257])
def test_a_tiff_without_a_width_or_a_height_is_one_line(missing, tmp_path):
    pytest.importorskip("tifffile")
    content = bytearray(cv2.imencode(".tiff", IMAGE)[1].tobytes())
    offset = struct.unpack_from("<I", content, 4)[0] + 2
    for place in range(offset, offset + 12 * struct.unpack_from("<H", content, offset - 2)[0], 12):
        if struct.unpack_from("<H", content, place)[0] == missing:
            struct.pack_into("<I", content, place + 8, 0)
    path = tmp_path / "image.tif"
    path.write_bytes(content)
    for read in (io.read_image, lambda path: open_source("left", path)):
        with pytest.raises(FileError, match=r"image\.tif"):
            read(path)


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_one_line(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(HOSTILE[name])
    readers = [io.read_image, lambda path: open_source("left", path)]
    readers += [io.read_disparity] if path.suffix in (".npy", ".pfm", ".tiff", ".tif", ".png") else []
    for read in readers:
        with pytest.raises(FileError) as caught:
            read(path)
        assert name in str(caught.value) and len(str(caught.value).splitlines()) == 1


def test_a_path_that_cannot_be_is_one_line(tmp_path):
    for read in (io.read_image, io.read_disparity, read_calibration):
        with pytest.raises(FileError, match=r"\\x00"):
            read("a\0b.png")
    with pytest.raises(FileError, match=r"\\x00"):
        open_source("left", "a\0b.npy")
    for write in (io.write_image, io.write_disparity):
        with pytest.raises(FileError, match=r"\\x00"):
            write(str(tmp_path / "a\0b.png"), np.zeros((2, 2), np.float32) if write is io.write_disparity else IMAGE)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("memory", ["9" * 400, "9" * 5000, 10**400, float("inf"), "1e5", -1, True])
def test_a_bound_of_memory_that_cannot_be_is_one_line(memory):
    with pytest.raises(OptionError, match="memory must be a number of bytes"):
        parse_memory(memory)
    assert parse_memory("1.5 GiB") == 3 * 2**29 and parse_memory(7.0) == 7


def test_text_has_any_mark_and_any_line_end(tmp_path):
    path = tmp_path / "a.txt"
    for data in (b"a\r\n\xc3\xa9\r\n", b"\xef\xbb\xbfa\n\xc3\xa9\n", "a\né\n".encode("utf-16"), "a\ré\n".encode()):
        path.write_bytes(data)
        assert io.read_text(path) == "a\né\n"
    path.write_bytes(b"caf\xe9")
    with pytest.raises(FileError, match="not a text file"):
        io.read_text(path)
    path.write_text('{"a": ' + "[" * 100_000)
    with pytest.raises(FileError, match="nested too deeply"):
        io.read_json(path, "manifest")


def test_lines_can_be_printed_anywhere():
    name = os.fsdecode(b"caf\xe9\n[/x]\x1b")
    assert one_line(name) == "caf\\udce9 [/x]\\x1b"
    assert one_line("é  ü\t") == "é ü"


# The same file, whatever reads it


def write_all(folder):
    """Write one image in many files; return their names."""
    np.save(folder / "a.npy", IMAGE)
    np.save(folder / "big_endian.npy", IMAGE.astype(">u2"))
    np.save(folder / "color.npy", COLOR)
    (folder / "npy_called.tif").write_bytes((folder / "a.npy").read_bytes())
    io.write_image(folder / "a.png", IMAGE)
    (folder / "png_called.npy").write_bytes((folder / "a.png").read_bytes())
    (folder / "png_called.tiff").write_bytes((folder / "a.png").read_bytes())
    names = ["a.npy", "big_endian.npy", "color.npy", "npy_called.tif", "a.png", "png_called.npy", "png_called.tiff"]
    tifffile = pytest.importorskip("tifffile", reason="TIFF is written with the extra 'large'")
    pytest.importorskip("imagecodecs", reason="rare compressions need the extra 'large'")
    for compression in ("none", "deflate", "lzw", "zstd", "lzma", "packbits"):
        names.append(f"{compression}.tif")
        tifffile.imwrite(folder / names[-1], IMAGE, compression=None if compression == "none" else compression)
    tifffile.imwrite(folder / "tiled.tif", COLOR, photometric="rgb", compression="zstd", tile=(16, 16))
    tifffile.imwrite(folder / "planar.tif", np.moveaxis(COLOR, 2, 0).copy(), photometric="rgb", planarconfig="separate")
    tifffile.imwrite(
        folder / "palette.tif", IMAGE, photometric="palette", colormap=np.stack([np.arange(256) * 257] * 3)
    )
    return [*names, "tiled.tif", "planar.tif", "palette.tif"]


def test_a_file_is_read_alike_with_and_without_a_bound_of_memory(tmp_path):
    for name in write_all(tmp_path):
        whole = io.read_image(tmp_path / name)
        source = open_source("left", tmp_path / name)
        assert source.shape == whole.shape and source.dtype == whole.dtype, name
        np.testing.assert_array_equal(source.read(5, 20, 7, 33), whole[5:20, 7:33], err_msg=name)
        expected = COLOR if name in ("color.npy", "tiled.tif", "planar.tif") else IMAGE
        expected = np.repeat(IMAGE[:, :, None], 3, axis=2) if name == "palette.tif" else expected
        np.testing.assert_array_equal(whole, expected, err_msg=name)


def test_a_rare_tiff_says_what_to_install(tmp_path, monkeypatch):
    names = write_all(tmp_path)
    assert "zstd.tif" in names
    monkeypatch.setitem(sys.modules, "tifffile", None)
    with pytest.raises(FileError, match=r"stereokit\[tiff\]"):
        io.read_image(tmp_path / "zstd.tif")


# Silence


BROKEN = {
    "crc.png": lambda: bytearray(cv2.imencode(".png", COLOR)[1].tobytes()),
    "huffman.jpg": lambda: bytearray(cv2.imencode(".jpg", COLOR)[1].tobytes()),
    "directory.tif": lambda: bytearray(cv2.imencode(".tif", COLOR)[1].tobytes()[:-200]),
    "stream.webp": lambda: bytearray(cv2.imencode(".webp", COLOR)[1].tobytes()[:-200]),
}


def broken(name):
    data = BROKEN[name]()
    middle = len(data) // 2
    data[middle : middle + 40] = bytes(range(200, 240))
    return bytes(data)


@pytest.fixture
def nobody_else(monkeypatch):
    """Let no thread but this one be there: pytest-xdist has some of its own."""
    real = threading.enumerate
    there = set(real())
    monkeypatch.setattr(
        threading, "enumerate", lambda: [t for t in real() if t not in there or t is threading.current_thread()]
    )


@pytest.mark.parametrize("name", BROKEN)
def test_decoders_say_nothing(name, tmp_path, capfd, nobody_else):
    (tmp_path / name).write_bytes(broken(name))
    for _ in range(2):
        try:
            io.read_image(tmp_path / name)
        except FileError:
            pass
    assert capfd.readouterr() == ("", "")
    os.write(2, b"as before\n")
    assert capfd.readouterr().err == "as before\n"


def test_others_may_write_while_a_decoder_is_silenced(capfd, nobody_else):
    stop = threading.Event()
    thread = threading.Thread(target=stop.wait, name="somebody else's")
    thread.start()
    try:
        with quiet.quiet_decoders():
            os.write(2, b"heard\n")
    finally:
        stop.set()
        thread.join()
    with quiet.quiet_decoders(), quiet.quiet_decoders():
        os.write(2, b"not heard\n")
    assert capfd.readouterr().err == "heard\n"
    assert quiet._log.getLogLevel() != quiet._SILENT


def test_the_command_line_says_one_line_for_each_broken_file(tmp_path, run_python):
    for name in BROKEN:
        (tmp_path / name).write_bytes(broken(name)[: 80 if "tif" not in name else None])
    for name in ("open.npy", "pages.tif", "digits.pfm", "empty.png"):
        (tmp_path / name).write_bytes(HOSTILE[name])
    script = tmp_path / "run.py"
    script.write_text(
        """
import os, sys, threading
folder, *names = sys.argv[1:]
os.dup2(os.open(folder + "/heard", os.O_WRONLY | os.O_CREAT), 2)
from stereokit.cli.app import main
threading.Thread(target=threading.Event().wait, daemon=True, name="somebody else's").start()
for name in names:
    for more in ([], ["--memory", "2GB"]):
        path = folder + "/" + name
        sys.argv[1:] = ["match", path, path, "-o", folder + "/out.npy", *more]
        try:
            main()
        except SystemExit as end:
            print(name, end.code)
"""
    )
    names = [*BROKEN, "open.npy", "pages.tif", "digits.pfm", "empty.png"]
    printed = run_python(script, tmp_path, *names)
    assert printed.split("\n")[:-1] == [f"{name} 2" for name in names for _ in range(2)]
    lines = (tmp_path / "heard").read_text().splitlines()
    assert len(lines) == 2 * len(names) and all(line.startswith("error: ") for line in lines), lines


# Calibrations


def test_numbers_of_any_length_and_depth_are_one_line(tmp_path):
    path = tmp_path / "calib.txt"
    for text in (
        '{"fx": ' + "1" * 5000 + "}",
        '{"fx": 1e999, "fy": 1, "cx0": 1, "cy": 1, "baseline_m": 1}',
        '{"fx": 1, "fy": 1, "cx0": 1, "cy": 1, "baseline_m": 1, "width": 1' + "0" * 400 + "}",
        "{" + '"a":' + "[" * 100_000,
        "cam0=[" + "9" * 5000 + " 0 1; 0 1 1; 0 0 1]\nbaseline=3\ndoffs=0\n",
        json.dumps({"fx": 1, "fy": 1, "cx0": float("nan"), "cy": 1, "baseline_m": 1}),
    ):
        path.write_text(text)
        with pytest.raises(FileError, match=r"calib\.txt"):
            read_calibration(path)
