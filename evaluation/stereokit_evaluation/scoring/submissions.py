"""Archives for the servers of the benchmarks, in their official layouts, checked before they are written.

Sources: the readme files of the KITTI 2012 and 2015 development kits ("Submission instructions"); "Instructions for
manually creating a ZIP file for upload" of the Middlebury Stereo Evaluation v3; the documentation of ETH3D ("Result
submission") with the packager of the Robust Vision Challenge.

* KITTI 2015: ``disp_0/000000_10.png`` to ``000199_10.png``, 16-bit, 256 steps to a pixel, 0 unknown.
* KITTI 2012: ``000000_10.png`` to ``000194_10.png`` in the root of the archive, the same format.
* Middlebury v3: ``trainingX/NAME/disp0METHOD.pfm`` (``disp0METHOD_s.pfm`` where pixels are unknown) and
  ``timeMETHOD.txt``, a number of seconds; X is the resolution F, H or Q. A full submission has ``testX`` too.
* ETH3D low-res two-view: ``low_res_two_view/NAME.pfm`` and ``NAME.txt`` with ``runtime SECONDS``.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import FileError, InputError, OptionError
from stereokit.io import read_text, replacing
from stereokit.io.images import encode
from stereokit.io.pfm import pfm_bytes
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring.runner import Estimator

__all__ = ["BENCHMARKS", "PARTS", "Submission", "expected_frames", "write_archive"]

BENCHMARKS = ("kitti2015", "kitti2012", "middlebury", "eth3d")
PARTS = ("test", "training", "all")
"""Parts of a benchmark: KITTI takes its test frames alone, the others training frames, or all."""

_KITTI = {
    "kitti2015": (200, (("image_2", "image_3"),)),
    "kitti2012": (195, (("image_0", "image_1"), ("colored_0", "colored_1"))),
}
_MIDDLEBURY = {
    "training": (
        "Adirondack ArtL Jadeplant Motorcycle MotorcycleE Piano PianoL Pipes Playroom Playtable PlaytableP Recycle "
        "Shelves Teddy Vintage"
    ).split(),
    "test": (
        "Australia AustraliaP Bicycle2 Classroom2 Classroom2E Computer Crusade CrusadeP Djembe DjembeL Hoops "
        "Livingroom Newkuba Plants Staircase"
    ).split(),
}
_LONG_AND_SHORT = ("l", "s")
_ETH3D = {
    "training": [
        *(
            f"{place}_{n}{view}"
            for place in ("delivery_area", "electro")
            for n in (1, 2, 3)
            for view in _LONG_AND_SHORT
        ),
        *"facade_1s forest_1s forest_2s".split(),
        *(f"playground_{n}{view}" for n in (1, 2, 3) for view in _LONG_AND_SHORT),
        *"terrace_1s terrace_2s terrains_1l terrains_1s terrains_2l terrains_2s".split(),
    ],
    "test": [
        f"{place}{view}"
        for place in (
            "lakeside_1 sand_box_1 storage_room_1 storage_room_2_1 storage_room_2_2 storage_room_2 storage_room_3 "
            "tunnel_1 tunnel_2 tunnel_3"
        ).split()
        for view in _LONG_AND_SHORT
    ],
}
_SHOWN = 3  # missing files that a message names
_DATE = (1980, 1, 1, 0, 0, 0)  # of every file of an archive, so that the same maps give the same bytes


@dataclass(frozen=True)
class Submission:
    """A submission to a benchmark.

    Attributes
    ----------
    benchmark : str
        One of `BENCHMARKS`.
    frames : list of Frame
        All that it must have; `Frame.name` is the path in the archive without the file's ending (KITTI 2015:
        ``disp_0/000000_10``; Middlebury: ``trainingH/Teddy``).
    """

    benchmark: str
    frames: list[Frame]


def expected_frames(benchmark: str, root: Path, part: str | None = None, resolution: str | None = None) -> Submission:
    """Return the frames that a submission must have.

    Parameters
    ----------
    benchmark : str
        One of `BENCHMARKS`.
    root : Path
        The folder of the data set: that of ``testing`` (KITTI), ``MiddEval3`` or that of ``trainingX`` and ``testX``
        (Middlebury), that of ``two_view_training`` and ``two_view_test`` (ETH3D).
    part : {"test", "training", "all"}, optional
        By default ``test`` for KITTI and ``training`` for the others.
    resolution : {"F", "H", "Q"}, optional
        Of Middlebury's images, if the folder has several.

    Raises
    ------
    OptionError
        If there is no such benchmark, or it has no such part.
    FileError
        If an image is missing.
    """
    if benchmark not in BENCHMARKS:
        raise OptionError(f"benchmark must be one of {', '.join(BENCHMARKS)}, got {benchmark!r}")
    default, parts = ("test", ("test",)) if benchmark in _KITTI else ("training", ("training", "all"))
    part = default if part is None else part
    if part not in parts:
        raise OptionError(f"part of {benchmark} must be {' or '.join(parts)}, got {part!r}")
    if resolution is not None and benchmark != "middlebury":
        raise OptionError(f"resolution must go with middlebury, got {resolution!r} for {benchmark}")
    if not root.is_dir():
        raise FileError(f"root must be a folder, got {str(root)!r}, which is not")
    if benchmark in _KITTI:
        frames = _kitti_frames(benchmark, root)
    elif benchmark == "middlebury":
        frames = _middlebury_frames(root, part, resolution)
    else:
        frames = [
            _folder_frame(base / name, f"low_res_two_view/{name}")
            for which in (("training", "test") if part == "all" else (part,))
            for base in [_first_folder(root, f"two_view_{which}")]
            for name in _ETH3D[which]
        ]
    images = [path for frame in frames for path in (frame.left, frame.right) if isinstance(path, Path)]
    _check_files(f"{benchmark} needs both images of {len(frames)} pairs", images)
    return Submission(benchmark, frames)


def write_archive(
    path: Path,
    submission: Submission,
    estimate: Estimator,
    *,
    method: str = "stereokit",
    sparse: bool = False,
    seconds: Callable[[Frame], float | None] = lambda frame: None,
    step: Callable[[str], object] = lambda text: None,
) -> list[str]:
    """Write the archive; it appears only when every map has been found good.

    Parameters
    ----------
    path : Path
        A ``.zip`` file.
    submission : Submission
        Result of `expected_frames`.
    estimate : callable
        Turns a frame into an `Estimate`.
    method : str
        The method's name in Middlebury's files: letters, digits, ``_`` and ``-``.
    sparse : bool
        Allow maps with unknown pixels.
    seconds : callable
        Returns the time of a frame whose estimate has none.
    step : callable
        Called with a few words after each map.

    Returns
    -------
    list of str
        The names of the files in the archive.

    Raises
    ------
    InputError
        If a map has another size than its image, unknown pixels though it should be dense, or disparities that the
        format or the image cannot have; or if a time is missing that the benchmark asks for.
    FileError
        If a map is missing or the archive cannot be written.
    """
    if not re.fullmatch(r"[A-Za-z0-9_-]+", method) or method.endswith("_s"):
        raise OptionError(f"name must have letters, digits, _ and - alone, and not end in _s, got {method!r}")
    names: list[str] = []
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for frame in submission.frames:
            result = estimate(frame)
            disparity = np.asarray(result.disparity, np.float32)
            _check_map(submission.benchmark, frame, disparity, sparse)
            taken = seconds(frame) if result.seconds is None else result.seconds
            for name, data in _files(submission.benchmark, frame, disparity, taken, method + ("_s" if sparse else "")):
                entry = zipfile.ZipInfo(name, _DATE)
                entry.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(entry, data)
                names.append(name)
            step(frame.name)
    return names


def _files(
    benchmark: str, frame: Frame, disparity: NDArray[np.float32], seconds: float | None, method: str
) -> Iterable[tuple[str, bytes]]:
    """Return the names and contents of a frame's files."""
    known = np.isfinite(disparity)
    if benchmark in _KITTI:
        steps = np.rint(np.where(known, disparity, 0) * np.float32(256))
        return [(f"{frame.name}.png", encode(".png", np.where(known, np.maximum(steps, 1), 0).astype(np.uint16)))]
    if seconds is None or not (np.isfinite(seconds) and seconds >= 0):
        raise InputError(f"{benchmark} asks for the seconds of every map, got {seconds} for {frame.name}")
    if benchmark == "middlebury":
        time_file = f"time{method.removesuffix('_s')}.txt"
        files = {f"disp0{method}.pfm": pfm_bytes(disparity), time_file: f"{seconds:.6g}\n".encode()}
        return [(f"{frame.name}/{name}", data) for name, data in files.items()]
    text = f"runtime {seconds:.6g}\n".encode()
    return [(f"{frame.name}.pfm", pfm_bytes(disparity)), (f"{frame.name}.txt", text)]


def _check_map(benchmark: str, frame: Frame, disparity: NDArray[np.float32], sparse: bool) -> None:
    """Refuse a map that the server would refuse, or score as wrong."""
    height, width = frame.load_left().shape[:2]
    if disparity.shape != (height, width):
        raise InputError(f"{frame.name} must have the size of its image, {(height, width)}, got {disparity.shape}")
    known = np.isfinite(disparity)
    if not known.any():
        raise InputError(f"{frame.name} must have disparities, got none that is known")
    if not known.all() and not sparse:
        unknown = int(np.count_nonzero(~known))
        raise InputError(f"{frame.name} must be dense, got {unknown} unknown pixels; --sparse allows them")
    least, most = float(disparity[known].min()), float(disparity[known].max())
    limit = min(256.0 - 1 / 256, width) if benchmark in _KITTI else float(width)
    if least < 0 or most > limit:
        raise InputError(f"{frame.name} must have disparities from 0 to {limit:g} px, got {least:g} to {most:g}")


def _kitti_frames(benchmark: str, root: Path) -> list[Frame]:
    count, pairs = _KITTI[benchmark]
    base = root / "testing" if (root / "testing").is_dir() else root
    left, right = next((pair for pair in pairs if (base / pair[0]).is_dir()), pairs[0])
    prefix = "disp_0/" if benchmark == "kitti2015" else ""
    names = [f"{number:06d}_10" for number in range(count)]
    return [
        Frame(f"{prefix}{name}", base / left / f"{name}.png", base / right / f"{name}.png", max_disparity=128)
        for name in names
    ]


def _middlebury_frames(root: Path, part: str, resolution: str | None) -> list[Frame]:
    base = root / "MiddEval3" if (root / "MiddEval3").is_dir() else root
    there = [letter for letter in "FHQ" if (base / f"training{letter}").is_dir()]
    if resolution is not None and resolution not in ("F", "H", "Q"):
        raise OptionError(f"resolution must be F, H or Q, got {resolution!r}")
    if resolution is None:
        if len(there) != 1:
            names = ", ".join(f"training{letter}" for letter in there) or "none"
            raise OptionError(f"resolution must be given where there is not one folder trainingF, H or Q, got {names}")
        resolution = there[0]
    return [
        _folder_frame(base / f"{which}{resolution}" / name, f"{which}{resolution}/{name}")
        for which in (("training", "test") if part == "all" else (part,))
        for name in _MIDDLEBURY[which]
    ]


def _folder_frame(folder: Path, name: str) -> Frame:
    """Return the pair of a folder in the layout of Middlebury since 2014."""
    return Frame(name, folder / "im0.png", folder / "im1.png", max_disparity=_levels(folder / "calib.txt"))


def _levels(path: Path) -> int | None:
    if not path.is_file():
        return None
    match = re.search(r"^ndisp\s*=\s*([1-9][0-9]{0,5})\s*$", read_text(path, "calibration"), flags=re.MULTILINE)
    return int(match[1]) if match else None


def _first_folder(root: Path, name: str) -> Path:
    return root / name if (root / name).is_dir() else root


def _check_files(rule: str, paths: Sequence[Path]) -> None:
    missing = [str(path) for path in paths if not path.is_file()]
    if missing:
        more = f" and {len(missing) - _SHOWN} more" if len(missing) > _SHOWN else ""
        raise FileError(f"{rule}; missing {', '.join(missing[:_SHOWN])}{more}")
