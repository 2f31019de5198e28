"""The pairs of a batch: from a folder or a list file, listed by name before any image is read.

A folder, by the first rule that gives any pair:

1. ``--pattern LEFT RIGHT``, such as ``'*_cam0.png' '*_cam1.png'``: the star stands for the name.
2. Two folders in it, files paired by name without suffix: ``left`` and ``right``; ``image_2`` and ``image_3``,
   ``image_0`` and ``image_1``, ``colored_0`` and ``colored_1`` (KITTI); ``image_02`` and ``image_03``, ``image_00`` and
   ``image_01`` (KITTI raw), ``cam0`` and ``cam1`` (EuRoC), themselves or the folders ``data`` in them; all of them also
   below ``training``, ``testing`` or ``mav0``, in any case. Or the two folders themselves, as two inputs. Where no name
   is in both, the mark of the side is removed: ``left/a_left.png`` and ``right/a_right.png`` are ``a``.
3. Files in it whose names differ in the mark of the side: ``left`` and ``right``, ``l`` and ``r``, ``cam0`` and
   ``cam1``, in any case, at the start, at the end or between ``-``, ``_``, ``.`` and blanks, or next to digits
   (``left01``, ``01L``).
4. Folders in it, at any depth, that hold one pair each, or the folder itself: ``im0`` and ``im1`` (Middlebury 2014,
   ETH3D), ``im2`` and ``im6``, ``view1`` and ``view5``, ``left`` and ``right``. The folder's name is the pair's.

A list, ``.csv``, ``.tsv`` or ``.txt``: ``left,right`` or ``left,right,name`` on each line, in UTF-8; without commas,
tabs or blanks divide. Paths are relative to the list; the default name is the left file's without suffix.
Further columns that are files, such as the true disparity, count for nothing; nor do empty lines, lines that begin with
``#`` and a first line ``left,right``.

A name may be any file name. One that cannot be that of an output costs its own pair only.
"""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from stereokit.errors import FileError, OptionError
from stereokit.io import DISPARITY_SUFFIXES, IMAGE_SUFFIXES, READABLE_SUFFIXES, parsing, read_text

__all__ = ["LIST_SUFFIXES", "PairFiles", "folder_pairs", "folders_pairs", "list_pairs"]

LIST_SUFFIXES = (".csv", ".tsv", ".txt")
_SIDE_FOLDERS = (
    ("left", "right"),
    *((f"image_{a}", f"image_{b}") for a, b in ((2, 3), (0, 1))),
    ("colored_0", "colored_1"),
    *((f"image_{a}", f"image_{b}") for a, b in (("02", "03"), ("00", "01"))),
    ("cam0", "cam1"),
)
_ABOVE = ("training", "testing", "mav0")
_SCENE_FILES = (("im2", "im6"), ("im0", "im1"), ("view1", "view5"), ("left", "right"))
_SURE = (
    re.compile(r"(?P<name>.*)[-_.](?:(?P<left>left|l)|(?P<right>right|r))", re.IGNORECASE | re.DOTALL),
    re.compile(r"(?:(?P<left>left)|(?P<right>right))[-_.](?P<name>.*)", re.IGNORECASE | re.DOTALL),
)
"""Whole names without suffix; a missing view of these is an error."""
_LIKELY = (
    re.compile(
        r"[-_. ]?(?<![a-z])(?:(?P<left>left|l|cam0(?!\d))|(?P<right>right|r|cam1(?!\d)))(?![a-z])[-_. ]?", re.IGNORECASE
    ),
    re.compile(r"(?<=[a-z])(?:(?P<left>Left|L)|(?P<right>Right|R))(?![a-z])[-_. ]?"),
)
"""Parts of names, of which both views must be there."""
_FILES = frozenset((*READABLE_SUFFIXES, *DISPARITY_SUFFIXES))


@dataclass(frozen=True)
class PairFiles:
    """One pair: a unique name, and two files, which may be missing.

    Attributes
    ----------
    name : str
    left, right : str or None
    reason : str
        The reason why there is no file, where there is none.
    """

    name: str
    left: str | None
    right: str | None
    reason: str = ""


def folder_pairs(folder: Path, pattern: tuple[str, str] | None = None) -> list[PairFiles]:
    """Return the pairs of a folder, sorted by name.

    Parameters
    ----------
    folder : Path
    pattern : (left, right) or None
        Names of files in it, each with one ``*``.

    Raises
    ------
    FileError
        If there are none, or two files would have one name.
    OptionError
        If a pattern has no star, or more than one.
    """
    if pattern is not None:
        starred = [re.compile("(.*)".join(map(re.escape, _halves(part))), re.DOTALL) for part in pattern]
        files = _files(folder)
        sides = [_named(folder, ((m[1], f) for f in files if (m := star.fullmatch(f)))) for star in starred]
        return _joined(sides, pattern, f"files {pattern[0]!r} and {pattern[1]!r} in {str(folder)!r}")
    for left, right in _side_folders(folder):
        return folders_pairs(left, right)
    sides = _by_side(folder, _files(folder))
    if sides[0] or sides[1]:
        return _joined(sides, ("{}_left.png", "{}_right.png"), "pairs")
    scenes = list(_scenes(folder))
    if scenes:
        return scenes
    raise FileError(
        f"no pairs in {str(folder)!r}: it has neither folders left and right, image_2 and image_3 or cam0 and cam1, "
        "nor files NAME_left and NAME_right, nor folders with im0 and im1; "
        "use --pattern for other names, such as --pattern '*_a.png' '*_b.png'"
    )


def folders_pairs(left: Path, right: Path) -> list[PairFiles]:
    """Return the pairs of a folder of left and a folder of right images, sorted by name; see `folder_pairs`."""
    sides = [_stems(folder) for folder in (left, right)]
    if not sides[0].keys() & sides[1].keys():
        bare = [_by_side(folder, _files(folder), k)[k] for k, folder in enumerate((left, right))]
        sides = bare if bare[0].keys() & bare[1].keys() else sides
    missing = f"{left}{os.sep}{{}}.png", f"{right}{os.sep}{{}}.png"
    return _joined(sides, missing, f"images in {str(left)!r} and {str(right)!r}")


def list_pairs(path: Path) -> list[PairFiles]:
    """Return the pairs of a list file, in its order.

    Raises
    ------
    FileError
        If it cannot be read, a line breaks the format, or two lines have one name.
    """
    lines = read_text(path, "list").split("\n")
    base = os.path.dirname(os.path.abspath(path))
    pairs: list[PairFiles] = []
    seen: dict[str, int] = {}
    first = True
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        with parsing(path, "list"):
            cells = [cell.strip() for cell in _cells(text)]
        head = [cell.lower() for cell in cells[:2]] if first else []
        first = False
        if head == ["left", "right"]:
            continue
        if head == ["right", "left"]:
            raise FileError(f"{str(path)!r} line {number}: the left view must come first, got the columns {text!r}")
        while len(cells) > 2 and _is_file(cells[-1]):  # the true disparity, say
            cells.pop()
        if len(cells) not in (2, 3) or not all(cells):
            raise FileError(f"{str(path)!r} line {number} must be left,right or left,right,name, got {text!r}")
        name = cells[2] if len(cells) == 3 else os.path.splitext(os.path.basename(cells[0]))[0]
        if _bad_name(name):
            raise FileError(f"{str(path)!r} line {number}: name must be a file name or folder/name, got {name!r}")
        if name in seen:
            raise FileError(
                f"{str(path)!r} line {number}: name {name!r} is that of line {seen[name]} too; give names of their own"
            )
        seen[name] = number
        pairs.append(PairFiles(name, os.path.join(base, cells[0]), os.path.join(base, cells[1])))
    if not pairs:
        raise FileError(f"no pairs in {str(path)!r}")
    return pairs


def _cells(text: str) -> Sequence[str]:
    if '"' in text and "," in text:
        return next(csv.reader([text], skipinitialspace=True))
    if "," in text:
        return text.split(",")
    return text.split("\t") if "\t" in text else text.split()


def _bad_name(name: str) -> bool:
    return "\0" in name or any(not part or part.startswith(".") for part in name.split("/"))


def _is_file(cell: str) -> bool:
    return os.path.splitext(cell)[1].lower() in _FILES


def _is_image(file: str) -> bool:
    return os.path.splitext(file)[1].lower() in READABLE_SUFFIXES


def _halves(pattern: str) -> list[str]:
    parts = pattern.split("*")
    if len(parts) != 2 or "/" in pattern:
        raise OptionError(f"pattern must be the name of a file with one *, got {pattern!r}")
    return parts


def _files(folder: Path) -> list[str]:
    return _entries(folder, folders=False)


def _entries(folder: Path, folders: bool) -> list[str]:
    with parsing(folder, "folder"), os.scandir(folder) as entries:
        return sorted(e.name for e in entries if not e.name.startswith(".") and e.is_dir() == folders)


def _side_folders(folder: Path) -> Iterator[tuple[Path, Path]]:
    """Yield the pairs of folders in a folder that are named after the sides, the most specific first."""
    top = _lowered(folder)
    for place in (top, *(_lowered(top[name]) for name in _ABOVE if name in top)):
        for names in _SIDE_FOLDERS:
            if all(name in place for name in names):
                left, right = (place[name] for name in names)
                inside = left / "data", right / "data"
                yield inside if all(map(Path.is_dir, inside)) else (left, right)


def _lowered(folder: Path) -> dict[str, Path]:
    """Return the folders in a folder by their names in lower case; an exact name has priority."""
    names = _entries(folder, folders=True)
    return {name.lower(): folder / name for name in sorted(names, key=str.islower)}


def _scenes(folder: Path) -> Iterator[PairFiles]:
    """Yield the pairs of all folders at and below a folder, one pair per folder, named after the folders."""
    for path, folders, files in os.walk(os.path.abspath(folder)):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        stems = {os.path.splitext(file)[0].lower(): file for file in sorted(files, reverse=True) if _is_image(file)}
        for left, right in _SCENE_FILES:
            if left in stems and right in stems:
                relative = os.path.relpath(path, folder).replace(os.sep, "/")
                name = os.path.basename(path) if relative == "." else relative
                yield PairFiles(name, os.path.join(path, stems[left]), os.path.join(path, stems[right]))
                break


def _by_side(folder: Path, files: Iterable[str], only: int | None = None) -> list[dict[str, str]]:
    """Return the images of a folder with a mark of the side in their names, by the rest of the name.

    With `only`, 0 or 1, the folder has the images of one side, and the other view may be missing.
    """
    files_by_side: list[list[tuple[str, str]]] = [[], []]
    certain: set[str] = set()
    for file in filter(_is_image, files):
        stem = os.path.splitext(file)[0]
        match = next(filter(None, (pattern.fullmatch(stem) for pattern in _SURE)), None)
        if match is not None:
            name = match["name"]
            certain.add(name)
        else:
            match = next((matches[-1] for p in _LIKELY if (matches := list(p.finditer(stem)))), None)
            if match is None:
                continue
            name = "_".join(filter(None, (stem[: match.start()], stem[match.end() :])))
        if name:
            files_by_side[0 if match["left"] else 1].append((name, file))
    left, right = (_named(folder, part) for part in files_by_side)
    both = left.keys() & right.keys()
    return [{n: f for n, f in side.items() if n in both or n in certain or only is not None} for side in (left, right)]


def _stems(folder: Path) -> dict[str, str]:
    return _named(folder, ((os.path.splitext(file)[0], file) for file in _files(folder) if _is_image(file)))


def _named(folder: Path, files: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return files by name; of several files of one name the one with an image suffix."""
    paths: dict[str, str] = {}
    for name, file in files:
        if name in paths:
            other = os.path.basename(paths[name])
            images = [f for f in (other, file) if os.path.splitext(f)[1].lower() in IMAGE_SUFFIXES]
            if len(images) != 1:
                raise FileError(f"{str(folder)!r} has two images named {name!r}: {other!r} and {file!r}")
            file = images[0]
        paths[name] = os.path.join(os.path.abspath(folder), file)
    return paths


def _joined(sides: Sequence[dict[str, str]], missing: tuple[str, str], content: str) -> list[PairFiles]:
    """Return the pairs of all names of either side; a missing file gets its expected path."""
    left, right = sides
    if not left and not right:
        raise FileError(f"no {content}")

    def path(k: int, name: str) -> str:
        return sides[k].get(name) or missing[k].replace("*", name).replace("{}", name)

    def pair(name: str) -> PairFiles:
        if _bad_name(name):
            file = os.path.basename(left.get(name) or right[name])
            return PairFiles(file, None, None, f"{file!r} gives the name {name!r}, which cannot be that of a file")
        return PairFiles(name, path(0, name), path(1, name))

    return [pair(name) for name in sorted(left.keys() | right.keys())]
