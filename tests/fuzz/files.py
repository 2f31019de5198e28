"""Mutated files: every reader gives a value or one of stereokit's errors, and takes no memory for a claimed size."""

from __future__ import annotations

import json
import resource
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

import stereokit
from stereokit.calibration import read_calibration
from stereokit.errors import StereokitError
from stereokit.large.sources import open_source
from stereokit.rig import Camera, StereoRig, read_rig
from stereokit_evaluation.batch.pairs import list_pairs
from stereokit_evaluation.batch.store import open_output
from stereokit_refiners.weights import read as read_weights

__all__ = ["run_file"]

Rng = np.random.Generator

MOST_GROWTH = 2**28
"""Bytes by which the largest memory of the process may grow while one small file is read."""

NUMBERS = (b"-1", b"0", b"99999999999", b"9" * 5000, b"nan", b"inf", b"1e999", b"0x10", b"null", b"[]", b"{}", b"\xff")


@cache
def image() -> np.ndarray:
    """Return the picture that image files hold."""
    return np.random.default_rng(0).integers(0, 256, (12, 17), dtype=np.uint8)


def encoded(suffix: str, array: np.ndarray) -> bytes:
    """Return an image as OpenCV writes it."""
    return bytes(cv2.imencode(suffix, array)[1])


KALIBR = b"""cam0:
  camera_model: pinhole
  intrinsics: [461.6, 460.1, 362.7, 246.0]
  distortion_model: radtan
  distortion_coeffs: [-0.27, 0.06, 0.0008, 0.0001]
  resolution: [752, 480]
cam1:
  camera_model: pinhole
  intrinsics: [460.6, 461.1, 360.7, 244.0]
  distortion_model: radtan
  distortion_coeffs: [-0.26, 0.05, 0.0007, 0.0002]
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  resolution: [752, 480]
"""
ROS = b"""image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [700, 0, 320, 0, 700, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}
projection_matrix: {rows: 3, cols: 4, data: [700, 0, 320, -70, 0, 700, 240, 0, 0, 0, 1, 0]}
"""
ZED = (
    b"[LEFT_CAM_HD]\nfx=700\nfy=700\ncx=640\ncy=360\nk1=-0.17\n[RIGHT_CAM_HD]\nfx=701\nfy=700\ncx=630\ncy=361\n"
    b"[STEREO]\nBaseline=120\nTY=0.1\nRX_HD=0.001\n"
)


@cache
def rigs() -> dict[str, bytes]:
    """Return a rig as it is saved, by suffix."""
    lens = Camera([[700, 0, 320], [0, 700, 240], [0, 0, 1]], (-0.2, 0.1, 0, 0, 0), width=640, height=480)
    content = {}
    with TemporaryDirectory() as folder:
        for suffix in (".yml", ".xml", ".json"):
            path = Path(folder, f"rig{suffix}")
            StereoRig(lens, lens, np.eye(3), (-0.1, 0, 0)).save(path)
            content[suffix] = path.read_bytes()
    return content


@cache
def samples() -> dict[str, tuple[bytes, ...]]:
    """Return good files by suffix."""
    grey, disparity = image(), image().astype(np.float32) / 4
    npy = []
    for array in (disparity, grey, disparity.astype(">f8"), np.asfortranarray(grey.astype(np.uint16))):
        header = repr({"descr": array.dtype.str, "fortran_order": array.flags.fnc, "shape": array.shape}).encode()
        header += b" " * (63 - (10 + len(header)) % 64) + b"\n"
        npy.append(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + array.tobytes("A"))
    camera = {"fx": 700.0, "fy": 700.0, "cx0": 320.0, "cy": 240.0, "baseline_m": 0.1, "width": 17, "height": 12}
    kitti = "".join(f"P_rect_0{k}: 7e2 0 6e2 {-380.0 * k} 0 7e2 2e2 0 0 0 1 0\n" for k in range(4))
    middlebury = "cam0=[700 0 320; 0 700 240; 0 0 1]\ncam1=[700 0 330; 0 700 240; 0 0 1]\ndoffs=10\nbaseline=100\n"
    manifest = {"format": 1, "method": "census+sgm", "options": {"max_disparity": 64}, "inputs": ["a", "b"]}
    weights = Path(read_weights.__code__.co_filename).parent / "weights" / "evidence.safetensors"
    return {
        ".npy": tuple(npy),
        ".pfm": (b"Pf\n17 12\n-1\n" + disparity.tobytes(), b"Pf\n17 12\n1\n" + disparity.astype(">f4").tobytes()),
        ".png": (encoded(".png", grey.astype(np.uint16) * 256), encoded(".png", grey)),
        ".tiff": (encoded(".tiff", disparity), encoded(".tiff", grey)),
        ".jpg": (encoded(".jpg", grey),),
        ".pgm": (encoded(".pgm", grey),),
        ".json": (json.dumps(camera).encode(), rigs()[".json"]),
        ".yml": (rigs()[".yml"], KALIBR, ROS),
        ".xml": (rigs()[".xml"],),
        ".conf": (ZED,),
        ".txt": (middlebury.encode() + b"width=17\nheight=12\nndisp=64\n", kitti.encode()),
        ".csv": (b"left,right\na.png,b.png\nc.png,d.png,name\n", b"a.png\tb.png\nc.png\td.png\tsub/name\n"),
        ".safetensors": (weights.read_bytes(),),
        "manifest.json": (json.dumps(manifest).encode(),),
    }


def _manifest(path: Path) -> None:
    with open_output(path.parent, {"format": 1}, ".png", lambda name: True, False):
        pass


READERS: dict[str, tuple[Callable[[Path], Any], ...]] = {
    ".npy": (stereokit.read_disparity, lambda path: open_source("left", path)),
    ".pfm": (stereokit.read_disparity,),
    ".png": (stereokit.read_disparity, stereokit.read_image, lambda path: open_source("left", path)),
    ".tiff": (stereokit.read_disparity, stereokit.read_image, lambda path: open_source("left", path)),
    ".jpg": (stereokit.read_image,),
    ".pgm": (stereokit.read_image,),
    ".json": (read_calibration, read_rig),
    ".yml": (read_rig, read_calibration),
    ".xml": (read_rig, read_calibration),
    ".conf": (lambda path: read_rig(path, size=(1280, 720)),),
    ".txt": (read_calibration, read_rig, list_pairs),
    ".csv": (list_pairs,),
    ".safetensors": (read_weights,),
    "manifest.json": (_manifest,),
}


def mutated(rng: Rng, content: bytes) -> bytes:
    """Return a file with one to four faults."""
    data = bytearray(content)
    near = min(len(data), 2000) if rng.random() < 0.7 else len(data)  # headers are where it matters
    for _ in range(rng.integers(1, 5)):
        offset = int(rng.integers(0, max(near, 1)))
        kind = rng.integers(9)
        if kind == 0 and data:
            data[offset % len(data)] ^= 1 << int(rng.integers(8))
        elif kind == 1 and data:
            data[offset % len(data)] = int(rng.choice([0, 255, 10, 32, 34, 39, 40, 44, 58, 91, 123]))
        elif kind == 2:
            del data[offset : offset + int(rng.integers(1, 40))]
        elif kind == 3:
            data = data[:offset]
        elif kind == 4:
            data[offset:offset] = rng.bytes(int(rng.integers(1, 40)))
        elif kind == 5:
            data[offset:offset] = data[offset : offset + int(rng.integers(1, 100))]
        elif kind == 6:
            value = int(rng.choice([0, 1, 2**15, 2**31 - 1, 2**32 - 1]))
            data[offset : offset + 4] = struct.pack(str(rng.choice(["<I", ">I"])), value)
        elif kind == 7:
            data[offset:offset] = NUMBERS[rng.integers(len(NUMBERS))]
        else:
            data[offset:offset] = bytes(rng.choice([b"[", b"{", b'"', b"(", b"\n", b"\0", b"="])) * int(
                rng.choice([1, 3, 20000])
            )
    return bytes(data)


def run_file(seed: int, number: int, folder: Path) -> int:
    """Mutate one file and have all its readers read it; return 1.

    Raises
    ------
    Exception
        Whatever is a finding.
    """
    rng = np.random.default_rng([seed, 1, number])
    suffixes = list(READERS)
    suffix = suffixes[number % len(suffixes)]
    good = samples()[suffix]
    place = folder / "batch"
    place.mkdir(exist_ok=True)
    path = place / suffix if suffix == "manifest.json" else folder / f"file{suffix}"
    path.write_bytes(mutated(rng, good[rng.integers(len(good))]))
    for read in READERS[suffix]:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            read(path)
        except StereokitError as error:
            if "\n" in str(error):
                raise AssertionError(f"not one line: {error}") from error
        grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
        if grown > MOST_GROWTH:
            raise AssertionError(f"{grown} bytes of memory for a file of {path.stat().st_size}")
    return 1
