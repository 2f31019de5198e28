"""Which pairs a batch has: a folder, a list file or a video, listed by name before any image is read.

A folder, the first rule that finds anything:

1. ``--pattern LEFT RIGHT``, such as ``'*_cam0.png' '*_cam1.png'``: what the star stands for is the name.
2. Two folders in it, files paired by name without suffix: ``left`` and ``right``; ``image_2`` and ``image_3``,
   ``image_0`` and ``image_1``, ``colored_0`` and ``colored_1`` (KITTI, also below ``training`` or ``testing``);
   ``image_02/data`` and ``image_03/data`` (KITTI raw). Or the two folders themselves, as two inputs.
3. Files in it: ``NAME_left`` and ``NAME_right``, ``NAME_l`` and ``NAME_r``, ``left_NAME`` and ``right_NAME``; a ``-``
   or a ``.`` will do for the ``_``, and any case.

A list, ``.csv``, ``.tsv`` or ``.txt``: ``left,right`` or ``left,right,name`` on each line, in UTF-8; without commas,
tabs or blanks divide. Paths are relative to the list; the name is the left file's without suffix where none is given.
Empty lines, lines that begin with ``#`` and a first line ``left,right`` count for nothing.
"""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from stereokit.errors import FileError, OptionError
from stereokit.io import IMAGE_SUFFIXES

__all__ = ["LIST_SUFFIXES", "Pair", "folder_pairs", "folders_pairs", "list_pairs"]

LIST_SUFFIXES = (".csv", ".tsv", ".txt")
_FOLDERS = (
    ("left", "right"),
    *((f"{top}image_{a}", f"{top}image_{b}") for top in ("", "training/", "testing/") for a, b in ((2, 3), (0, 1))),
    *((f"{top}colored_0", f"{top}colored_1") for top in ("", "training/", "testing/")),
    ("image_02/data", "image_03/data"),
)
_PART = r"""[^./\x00-\x1f\\:*?"<>|][^/\x00-\x1f\\:*?"<>|]*"""
_NAME = re.compile(f"{_PART}(?:/{_PART})*")
_SIDES = (
    re.compile(r"(?P<name>.*)[-_.](?P<side>left|right|l|r)", re.IGNORECASE),
    re.compile(r"(?P<side>left|right)[-_.](?P<name>.*)", re.IGNORECASE),
)


@dataclass(frozen=True)
class Pair:
    """One pair: a name, which no other pair has, and two files, which may turn out not to be there."""

    name: str
    left: str
    right: str


def folder_pairs(folder: Path, pattern: tuple[str, str] | None = None) -> list[Pair]:
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
        starred = [re.compile(".*".join(map(re.escape, _halves(part))).replace(".*", "(.*)")) for part in pattern]
        files = _files(folder)
        sides = [_named(folder, ((m[1], f) for f in files if (m := star.fullmatch(f)))) for star in starred]
        return _joined(sides, pattern, f"files {pattern[0]!r} and {pattern[1]!r} in {str(folder)!r}")
    for left, right in _FOLDERS:
        if (folder / left).is_dir() and (folder / right).is_dir():
            return folders_pairs(folder / left, folder / right)
    found: dict[str, list[tuple[str, str]]] = {"l": [], "r": []}
    for file in _files(folder):
        stem, suffix = os.path.splitext(file)
        if suffix.lower() in IMAGE_SUFFIXES and (
            match := next(filter(None, (s.fullmatch(stem) for s in _SIDES)), None)
        ):
            found[match["side"][0].lower()].append((match["name"], file))
    sides = [_named(folder, found[side]) for side in "lr"]
    rule = "left and right, image_2 and image_3, or files NAME_left and NAME_right"
    return _joined(sides, ("{}_left.png", "{}_right.png"), f"pairs in {str(folder)!r}: it has neither folders {rule}")


def folders_pairs(left: Path, right: Path) -> list[Pair]:
    """Return the pairs of a folder of left and a folder of right images, sorted by name; see `folder_pairs`."""
    sides = [_stems(folder) for folder in (left, right)]
    missing = f"{left}{os.sep}{{}}.png", f"{right}{os.sep}{{}}.png"
    return _joined(sides, missing, f"images in {str(left)!r} and {str(right)!r}")


def list_pairs(path: Path) -> list[Pair]:
    """Return the pairs of a list file, in its order.

    Raises
    ------
    FileError
        If it cannot be read, a line is not what it should be, or two lines have one name.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise FileError(f"{str(path)!r} is not UTF-8 text") from error
    except OSError as error:
        raise FileError(f"cannot read {str(path)!r}: {error.strerror or error}") from error
    base = os.path.dirname(os.path.abspath(path))
    pairs: list[Pair] = []
    seen: dict[str, int] = {}
    first = True
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        cells = [cell.strip() for cell in _cells(text)]
        if first and [cell.lower() for cell in cells] in (["left", "right"], ["left", "right", "name"]):
            first = False
            continue
        first = False
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
        pairs.append(Pair(name, os.path.join(base, cells[0]), os.path.join(base, cells[1])))
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
    return _NAME.fullmatch(name) is None


def _halves(pattern: str) -> list[str]:
    parts = pattern.split("*")
    if len(parts) != 2 or "/" in pattern:
        raise OptionError(f"pattern must be the name of a file with one *, got {pattern!r}")
    return parts


def _files(folder: Path) -> list[str]:
    try:
        with os.scandir(folder) as entries:
            return sorted(entry.name for entry in entries if not entry.name.startswith(".") and not entry.is_dir())
    except OSError as error:
        raise FileError(f"cannot read {str(folder)!r}: {error.strerror or error}") from error


def _stems(folder: Path) -> dict[str, str]:
    split = ((os.path.splitext(file), file) for file in _files(folder))
    return _named(folder, ((stem, file) for (stem, suffix), file in split if suffix.lower() in IMAGE_SUFFIXES))


def _named(folder: Path, files: Iterable[tuple[str, str]]) -> dict[str, str]:
    found: dict[str, str] = {}
    for name, file in files:
        if name in found:
            other = os.path.basename(found[name])
            raise FileError(f"{str(folder)!r} has two images named {name!r}: {other!r} and {file!r}")
        if _bad_name(name):
            raise FileError(f"{str(folder)!r}: {file!r} gives the name {name!r}, which cannot be that of a file")
        found[name] = os.path.join(os.path.abspath(folder), file)
    return found


def _joined(sides: Sequence[dict[str, str]], missing: tuple[str, str], what: str) -> list[Pair]:
    """Return all names of either side; a file that is missing has the path that it should have had."""
    left, right = sides
    if not left and not right:
        raise FileError(f"no {what}")

    def path(k: int, name: str) -> str:
        return sides[k].get(name) or missing[k].replace("*", name).replace("{}", name)

    return [Pair(name, path(0, name), path(1, name)) for name in sorted(left.keys() | right.keys())]
