"""Stereo data sets as lists of frames that load on demand.

Each function reads one published layout, or one of our own, and returns frames sorted by name. Only file names
are read until a frame's ``load_`` method is called, so that a broken file costs one frame and not the run. Ground
truth comes in two kinds, as in KITTI: *noc*, the pixels that both cameras see, and *occ*, all pixels.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.calibration import Calibration, read_calibration
from stereokit.errors import FileError, OptionError, UnknownNameError, did_you_mean
from stereokit.io import DISPARITY_SUFFIXES, READABLE_SUFFIXES, read_disparity, read_image, read_text
from stereokit_evaluation.data.frame import Benchmark, Frame, Loader, select_frames

__all__ = [
    "DATASETS",
    "Frame",
    "data_set",
    "dataset_names",
    "eth3d",
    "folder",
    "kitti2012",
    "kitti2015",
    "load_frames",
    "middlebury",
    "scenes",
    "select_frames",
]

_KITTI_DISPARITIES = 128  # the study's D; a few pixels of the ground truth lie beyond
_LEVELS = {"2001": 8, "2003": 4, "2006": 3}  # levels a pixel in the 8-bit disparity maps
_WIDEST = {"2001": 1000, "2003": 450, "2006": 480}  # a wider image is of a larger edition, with other levels
_SCENE_SIZE = (640, 384)  # width, height
_MAPS = (*DISPARITY_SUFFIXES, ".tif")
_ETH3D_DISPARITIES = 64  # its calibrations name the width of the image; true disparities are well below this
_NEIGHBOURS = 10  # frames of KITTI with numbers next to each other, taken for one drive
_VARIANTS = {
    "middlebury": r"\b(Motorcycle|Piano|Playtable)[ELP]$",  # other exposure, light or rectification of one scene
    "eth3d": r"(.)_[0-9]+[ls]$",  # several pairs of one scene
}

DATASETS: dict[str, Callable[[str | Path], list[Frame]]] = {}
"""The data sets that live in a folder, by the names that the command line uses."""


def data_set(function: Callable[[str | Path], list[Frame]]) -> Callable[[str | Path], list[Frame]]:
    """File a function among `DATASETS` under its own name."""
    DATASETS[function.__name__] = function
    return function


@data_set
def kitti2015(root: str | Path) -> list[Frame]:
    """Return the frames of KITTI 2015: ``image_2``, ``image_3``, ``disp_noc_0``, ``disp_occ_0``, ``obj_map``.

    Parameters
    ----------
    root : str or Path
        The folder of ``training``, or ``training`` itself. Only the first pair of each frame, ``*_10``.
    """
    return _kitti("KITTI 2015", root, [("image_2", "image_3")], ("disp_noc_0", "disp_occ_0", "obj_map"))


@data_set
def kitti2012(root: str | Path) -> list[Frame]:
    """Return the frames of KITTI 2012: ``image_0``, ``image_1``, ``disp_noc`` and ``disp_occ``.

    Parameters
    ----------
    root : str or Path
        The folder of ``training``, or ``training`` itself. ``colored_0/1`` or ``colour_0/1`` serve where there
        is no ``image_0``.
    """
    pairs = [("image_0", "image_1"), ("colored_0", "colored_1"), ("colour_0", "colour_1")]
    return _kitti("KITTI 2012", root, pairs, ("disp_noc", "disp_occ", "obj_map"))


@data_set
def middlebury(root: str | Path) -> list[Frame]:
    """Return the Middlebury pairs in any folder at or below `root`, named by their folder.

    * 2001 (``im2``, ``im6``, ``disp2``: 8 levels a pixel) and 2003, quarter size (the same names in a folder
      ``cones`` or ``teddy``, or below one called 2003: 4 levels a pixel, and ``mask_nonocc`` for *noc*).
    * 2005 and 2006, third size (``view1``, ``view5``, ``disp1``: 3 levels a pixel). No *noc*.
    * 2014 and later (``im0``, ``im1``, ``disp0GT.pfm`` or ``disp0.pfm``, ``mask0nocc.png``, ``calib.txt``).

    In the 8-bit maps 0 is unknown. Larger editions of 2003 to 2006 have other levels; their maps are refused
    when they are loaded.
    """
    base = _root(root)
    frames = [*_with_calibration(base, "middlebury")]
    for path in _images_below(base):
        if path.stem == "im2":
            modern = path.parent.name.lower() in ("cones", "teddy") or "2003" in path.parts
            frames.append(_scaled(base, "2003" if modern else "2001", path, "im6", "disp2"))
        elif path.stem == "view1":
            frames.append(_scaled(base, "2006", path, "view5", "disp1"))
    layouts = "folders with im0.png, im1.png, disp0GT.pfm or im2, im6, disp2 or view1, view5, disp1"
    return _sorted_frames("Middlebury", frames, base, layouts)


@data_set
def eth3d(root: str | Path) -> list[Frame]:
    """Return the ETH3D pairs below `root`: ``im0.png``, ``im1.png``, ``disp0GT.pfm``, ``mask0nocc.png``.

    The ``ndisp`` of its calibrations is about the width of the image and no range to search: 64 at most are suggested.
    """
    base = _root(root)
    frames = [*_with_calibration(base, "eth3d")]
    return _sorted_frames("ETH3D", frames, base, "folders with im0.png, im1.png, disp0GT.pfm")


@data_set
def folder(root: str | Path) -> list[Frame]:
    """Return the pairs of a plain folder: ``left/NAME`` and ``right/NAME``, matched without extension.

    Ground truth, where there is any, lies in ``disp_noc`` and ``disp_occ``; ``disparity`` is another name of
    the latter, and object maps lie in ``obj_map``. Disparities are 16-bit KITTI PNG, PFM, NPY or TIFF.
    """
    base = _root(root)
    lefts, rights = _stems(base / "left", READABLE_SUFFIXES), _stems(base / "right", READABLE_SUFFIXES)
    noc, objects = _stems(base / "disp_noc", _MAPS), _stems(base / "obj_map", READABLE_SUFFIXES)
    occ = {**_stems(base / "disparity", _MAPS), **_stems(base / "disp_occ", _MAPS)}
    frames = [
        Frame(
            name,
            lefts.get(name, base / "left" / f"{name}.png"),
            rights.get(name, base / "right" / f"{name}.png"),
            noc=_lazy(read_disparity, noc.get(name)),
            occ=_lazy(read_disparity, occ.get(name)),
            objects=_lazy(read_image, objects.get(name)),
        )
        for name in lefts.keys() | rights.keys() | noc.keys() | occ.keys()
    ]
    return _sorted_frames(
        "plain", frames, base, "left/NAME.png, right/NAME.png, disparity/NAME.png (or .pfm, .npy, .tiff)"
    )


def scenes(count: int = 20) -> list[Frame]:
    """Return `count` synthetic pairs with exact ground truth; the n-th is always the same.

    Raises
    ------
    OptionError
        If `count` is below 1.
    """
    if count < 1:
        raise OptionError(f"count must be at least 1, got {count}")

    def loader(index: int, choose: Callable[[Any], NDArray[Any]]) -> Loader:
        return lambda: choose(_scene(index))

    return [
        Frame(
            f"scene_{index:03d}",
            loader(index, lambda scene: scene.left),
            loader(index, lambda scene: scene.right),
            noc=loader(index, lambda scene: scene.noc),
            occ=loader(index, lambda scene: scene.occ),
            objects=loader(index, lambda scene: scene.objects),
            calibration=partial(_scene_calibration, index),
        )
        for index in range(count)
    ]


def dataset_names() -> list[str]:
    """Return the names of all data sets, those of `DATASETS` and ``"scenes"``."""
    return [*DATASETS, "scenes"]


def load_frames(dataset: str, root: str | Path | None = None, *, count: int = 20) -> list[Frame]:
    """Return the frames of a data set by its name.

    Parameters
    ----------
    dataset : str
        A key of `DATASETS`, or ``"scenes"``.
    root : str or Path, optional
        Its folder; ``scenes`` needs none.
    count : int
        Number of frames of ``scenes``.

    Raises
    ------
    UnknownNameError, OptionError, FileError
        If there is no such data set, or `root` is missing or has none of its frames.
    """
    if dataset == "scenes":
        return scenes(count)
    if dataset not in DATASETS:
        raise UnknownNameError(did_you_mean("data set", dataset, dataset_names()))
    if root is None:
        raise OptionError(f"root must name the folder of data set {dataset!r}, got none")
    return DATASETS[dataset](root)


@lru_cache(maxsize=2)
def _scene(index: int) -> Any:
    """Draw a scene once for its images and maps, which are read one after the other."""
    return import_module("stereokit_evaluation.synthetic.scenes").generate(index, *_SCENE_SIZE)


def _scene_calibration(index: int) -> Calibration:
    scene = _scene(index)
    focal = float(scene.focal_px)
    return Calibration(focal, focal, float(scene.cx), float(scene.cy), float(scene.baseline_m))


def _kitti(title: str, root: str | Path, pairs: Sequence[tuple[str, str]], truth: Sequence[str]) -> list[Frame]:
    top = _root(root)
    base = top / "training" if (top / "training").is_dir() else top
    a, b = next((pair for pair in pairs if (base / pair[0]).is_dir()), pairs[0])
    noc, occ, objects = (base / part for part in truth)
    drives = _kitti_drives(base)
    # A frame with any existing part is listed, so that its missing parts are reported.
    names = {path.stem for part in (base / a, base / b, noc, occ) for path in part.glob("*_10.png")}
    frames = [
        Frame(
            name,
            base / a / f"{name}.png",
            base / b / f"{name}.png",
            noc=_lazy(read_disparity, _existing(noc / f"{name}.png")),
            occ=_lazy(read_disparity, _existing(occ / f"{name}.png")),
            objects=_lazy(read_image, _existing(objects / f"{name}.png")),
            max_disparity=_KITTI_DISPARITIES,
            calibration=_kitti_calibration(base, name, (2, 3) if a != "image_0" else (0, 1)),
            scene=_kitti_scene(name, drives),
        )
        for name in names
    ]
    wanted = f"[training/]{a}/*_10.png, {b}/*_10.png, {truth[0]}/*_10.png, {truth[1]}/*_10.png"
    return _sorted_frames(title, frames, top, wanted)


def _kitti_drives(base: Path) -> list[str]:
    """Return the drive of each training frame by number, of the development kit's ``train_mapping.txt`` if it is there.

    An empty text stands for a frame whose drive it does not name.
    """
    places = (place / part for place in (base, base.parent) for part in ("mapping", "devkit/mapping", "."))
    path = next((path for place in places if (path := place / "train_mapping.txt").is_file()), None)
    if path is None:
        return []
    words = [line.split() for line in read_text(path, "mapping").splitlines()]
    return [line[1] if len(line) > 1 else "" for line in words]


def _kitti_scene(name: str, drives: Sequence[str]) -> str:
    """Return the drive of a frame; without a mapping, the block of `_NEIGHBOURS` numbers that it is in.

    Frames with neighbouring numbers mostly are of one drive, often a second apart.
    """
    text = name.partition("_")[0]
    if not text.isdecimal() or len(text) > 18:
        return name
    number = int(text)
    if number < len(drives):
        return drives[number] or name
    first = number - number % _NEIGHBOURS
    return f"{first:06d}-{first + _NEIGHBOURS - 1:06d}"


def _kitti_calibration(base: Path, name: str, cameras: tuple[int, int]) -> Callable[[], Calibration] | None:
    number = name.partition("_")[0]
    places = (base / folder / f"{number}.txt" for folder in ("calib_cam_to_cam", "calib"))  # of 2015, of 2012
    path = next((path for path in places if path.exists()), None)
    return None if path is None else partial(read_calibration, path, cameras)


def _with_calibration(base: Path, benchmark: str) -> Iterator[Frame]:
    """Yield the pairs in the layout of Middlebury since 2014 and of ETH3D."""
    for left in _images_below(base):
        scene = left.parent
        if left.name != "im0.png" or _sibling(scene, "im2"):  # the scenes of 2001 hold im0 to im8
            continue
        truth = next((path for name in ("disp0GT.pfm", "disp0.pfm") if (path := scene / name).exists()), None)
        occ, mask = _lazy(read_disparity, truth), _existing(scene / "mask0nocc.png")
        name, fields = _name(base, scene), _fields(scene / "calib.txt")
        levels = _ndisp(fields)
        if benchmark == "eth3d" and levels is not None:
            levels = min(levels, _ETH3D_DISPARITIES)
        yield Frame(
            name,
            left,
            _sibling(scene, "im1") or scene / "im1.png",
            noc=None if occ is None or mask is None else partial(_masked, occ, mask),
            occ=occ,
            max_disparity=levels,
            calibration=partial(read_calibration, path) if (path := scene / "calib.txt").exists() else None,
            scene=re.sub(_VARIANTS[benchmark], r"\1", name),
            benchmark=Benchmark(benchmark, integer=fields.get("isint", "").strip() == "1"),
        )


def _scaled(base: Path, layout: str, left: Path, right: str, truth: str) -> Frame:
    """Return a pair whose disparity is an 8-bit image with several levels a pixel."""
    scene = left.parent
    truth_path, mask = _sibling(scene, truth), _sibling(scene, "mask_nonocc")
    levels = _LEVELS[layout]
    occ = None if truth_path is None else partial(_levels, truth_path, levels, _WIDEST[layout])
    return Frame(
        _name(base, scene),
        left,
        _sibling(scene, right) or scene / f"{right}{left.suffix}",
        noc=None if occ is None or mask is None else partial(_masked, occ, mask),
        occ=occ,
        max_disparity=-(-256 // levels // 16) * 16,
    )


def _levels(path: Path, levels: int, widest: int) -> NDArray[np.float32]:
    image = read_image(path, gray=True)
    if image.dtype != np.uint8:
        raise FileError(f"{path} must be an 8-bit disparity map, got {image.dtype}")
    if image.shape[1] > widest:
        raise FileError(f"{path} must be at most {widest} px wide at {levels} levels a pixel, got {image.shape[1]}")
    disparity: NDArray[np.float32] = image.astype(np.float32) / np.float32(levels)
    disparity[image == 0] = np.nan
    return disparity


def _masked(load_map: Loader, mask: Path) -> NDArray[np.float32]:
    """Return the disparity where the mask is white, seen by both cameras (grey: hidden from the right), else NaN."""
    disparity, seen = load_map(), read_image(mask, gray=True)
    if seen.shape != disparity.shape:
        raise FileError(f"{mask} must have the size of its map, {disparity.shape}, got {seen.shape}")
    return np.where(seen == 255, disparity, np.float32(np.nan))


def _fields(path: Path) -> dict[str, str]:
    """Return the ``name=value`` lines of a calibration file, none of a file that cannot be read."""
    try:
        lines = read_text(path, "calibration").splitlines()
    except FileError:  # reported when the calibration itself is read
        return {}
    return dict(line.strip().partition("=")[::2] for line in lines)


def _ndisp(fields: dict[str, str]) -> int | None:
    """Return ``ndisp``, the number of disparities, None if there is none."""
    text = re.fullmatch(r"\s*([1-9][0-9]{0,5})(?:\.0*)?\s*", fields.get("ndisp", ""))
    return int(text[1]) if text else None


def _root(root: str | Path) -> Path:
    base = Path(root)
    if not base.is_dir():
        raise FileError(f"root must be a folder, got {str(base)!r}, which is not")
    return base


def _sorted_frames(title: str, frames: list[Frame], root: Path, wanted: str) -> list[Frame]:
    if not frames:
        raise FileError(f"root has no {title} frames, got {str(root)!r}; expected {wanted}")
    return sorted(frames, key=lambda frame: frame.name)


def _images_below(base: Path) -> list[Path]:
    return sorted(path for path in base.rglob("*") if path.suffix.lower() in (".png", ".ppm", ".pgm"))


def _name(base: Path, scene: Path) -> str:
    return scene.relative_to(base).as_posix() if scene != base else scene.resolve().name


def _existing(path: Path) -> Path | None:
    return path if path.exists() else None


def _sibling(scene: Path, stem: str) -> Path | None:
    return next((path for end in (".png", ".ppm", ".pgm") if (path := scene / f"{stem}{end}").exists()), None)


def _stems(part: Path, endings: tuple[str, ...]) -> dict[str, Path]:
    return {path.stem: path for path in sorted(part.glob("*")) if path.suffix.lower() in endings}


def _lazy(read: Callable[[Path], NDArray[Any]], path: Path | None) -> Loader | None:
    return None if path is None else partial(read, path)
