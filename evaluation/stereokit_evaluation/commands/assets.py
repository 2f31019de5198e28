"""Models and textures of Debian packages for ``stereokit train --assets``, only those that are free to train on.

``python -m stereokit_evaluation.commands.assets FOLDER`` downloads the packages with Debian's own tools (``apt-get
download``, ``dpkg-deb``; no root needed), and takes from them what the package's copyright file, and the licence file
beside a model, put under CC0, into the public domain, or under CC BY. Everything else stays out: CC BY-SA, GPL,
whatever is not stated. A package's folder has a ``manifest.json`` with file, package, version, author and licence of
each asset, ``CREDITS.md`` with the attribution that CC BY asks for, and the copyright file itself. Stopped, it goes on
where it was; a package whose manifest is there is not looked at again, so that it works offline.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import os
import posixpath
import re
import shutil
import subprocess
import sys
import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from html import unescape
from pathlib import Path

from stereokit.errors import FileError, OptionError, StereokitError, one_line
from stereokit.io import make_folder, parsing, read_bytes, write_bytes
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.synthetic.assets import MANIFEST

__all__ = ["PACKAGES", "Copyright", "Entry", "allowed", "main", "take"]

_FREE = re.compile(r"CC0(-1\.0)?|public-domain|CC-BY-[1-4]\.[05](-[A-Z]+)?")
_TEXTURES = (".png", ".jpg", ".jpeg")
_MODELS = (".obj", ".mtl", *_TEXTURES)
_NO_COLOURS = re.compile(  # normal maps, masks, icons, glows: pictures that no surface looks like
    r"normal|[_-]nm\b|[_-]nrm|gloss|alpha|mask|shadow|icon|screenshot|glow|spark|skid|lightning|lightbox|transparence",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Entry:
    """An asset and its terms.

    Attributes
    ----------
    file : str
        Path in the package's folder.
    package, version : str
        Debian's source package.
    author, licence : str
        Of the work; the licence by its short name.
    note : str
        What the copyright file says beside it, such as where it came from.
    """

    file: str
    package: str
    version: str
    author: str
    licence: str
    note: str = ""


def allowed(licence: str) -> str | None:
    """Return the licence to use a work under, None if it is not among those that are free to train on.

    Parameters
    ----------
    licence : str
        Short name as in a Debian copyright file, also ``A and B`` or ``A or B``.
    """
    for choice in re.split(r"\s+or\s+", licence.strip()):
        parts = re.split(r"\s+and\s+|\s*,\s*", choice.strip(" ,"))
        if all(_FREE.fullmatch(part) for part in parts):
            return " and ".join(parts)
    return None


class Copyright:
    """A Debian copyright file (machine-readable, version 1.0): author, licence and note of each file.

    Parameters
    ----------
    text : str
    """

    def __init__(self, text: str) -> None:
        self._paragraphs: list[tuple[list[str], tuple[str, str, str]]] = []
        for block in re.split(r"\n[ \t]*\n", text):
            fields: dict[str, str] = {}
            name = ""
            for line in block.split("\n"):
                if line[:1] in (" ", "\t"):
                    fields[name] = f"{fields.get(name, '')}\n{line.strip()}"
                elif ":" in line:
                    name, _, value = line.partition(":")
                    name = name.lower()
                    fields[name] = value.strip()
            if "files" in fields:
                licence = fields.get("license", "").strip().split("\n")[0]
                terms = one_line(fields.get("copyright", "")), licence, one_line(fields.get("comment", ""))[:300]
                self._paragraphs.append((fields["files"].split(), terms))

    def terms(self, name: str, *, by_name: bool = False) -> tuple[str, str, str]:
        """Return author, licence and note of a file of the source package: of the last paragraph that fits.

        With `by_name` they are empty if that paragraph has a wildcard for it.
        """
        for patterns, terms in reversed(self._paragraphs):
            if name in patterns:
                return terms
            if any(fnmatch.fnmatchcase(name, pattern.replace("[", "[[]")) for pattern in patterns):
                return ("", "", "") if by_name else terms
        return "", "", ""


Works = Iterator[tuple[Entry, bytes]]


def _furniture(tree: Path, package: str, version: str, notice: Copyright) -> Works:
    """Yield the models of Sweet Home 3D's libraries, each with its MTL and pictures."""
    for path in sorted((tree / "usr/share/sweethome3d/furniture").glob("*.sh3f")):
        with parsing(path, "furniture library"), zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if _is_inside(name)]
            creators = _creators(archive.read("PluginFurnitureCatalog.properties").decode("latin-1"))
            own = {
                posixpath.dirname(name): _own_terms(archive.read(name).decode("utf-8", "replace"))
                for name in names
                if "/" in name
                and re.search(r"licen[cs]e.*\.(txt|html)$|^[^.]*\.html$", posixpath.basename(name).lower())
            }
            models = {posixpath.dirname(name) for name in names if name.lower().endswith(".obj")}
            for name in names:
                folder = posixpath.dirname(name)
                if folder not in models or not name.lower().endswith(_MODELS):
                    continue
                holder, general, note = notice.terms(f"{path.stem}/{name}")
                creator, stated = own.get(folder, ("", general))
                licence = allowed(stated)
                if licence is None or allowed(general) is None:  # the model's terms and those of its library
                    continue
                author = creator or creators.get(folder, "") or holder
                yield Entry(f"{path.stem}/{name}", package, version, author, licence, note), archive.read(name)


def _creators(catalogue: str) -> dict[str, str]:
    """Return the creator of each model of a catalogue by its folder."""
    fields = dict(re.findall(r"^((?:model|creator)#\d+)=(.*)$", catalogue, re.MULTILINE))
    pairs = ((value, fields.get(f"creator#{key[6:]}", "")) for key, value in fields.items() if key.startswith("model#"))
    return {posixpath.dirname(model.strip().lstrip("/")): creator.strip() for model, creator in pairs}


def _own_terms(text: str) -> tuple[str, str]:
    """Return author and licence that the licence file of a Blend Swap model states; an unknown licence is ``""``."""
    plain = one_line(unescape(re.sub(r"<[^>]*>", " ", re.sub(r"(?s)<(style|script)\b.*?</\1>", " ", text))))
    author = (
        re.search(r"released by (\S+) under", plain)
        or re.search(r'" by (.+?) Released under', plain)
        or re.search(r"(?:give credit to|created by|by:) (\S+?)[.,]? ", plain)
    )
    released = re.search(r"(?:[Rr]eleased under|under the following license:) (.{0,60})", plain)
    words = released.group(1).lower() if released else ""
    licence = ""
    if re.match(r"(creative commons )?(cc-?0|zero|public domain)", words):
        licence = "CC0"
    elif version := re.match(
        r"(?:creative commons )?(?:attribution|cc-?by) (\d\.\d)(?![\w -]*?(share|non|no deriv))", words
    ):
        licence = f"CC-BY-{version.group(1)}"
    return author.group(1).strip() if author else "", licence


def _textures(tree: Path, package: str, version: str, notice: Copyright) -> Works:
    """Yield the textures of SuperTuxKart's tracks; its models are of a format of its own."""
    root = tree / "usr/share/games/supertuxkart"
    for part in ("data/library", "data/textures", "data/tracks"):
        for path in sorted((root / part).rglob("*")):
            name = path.relative_to(root).as_posix()
            if path.suffix.lower() not in _TEXTURES or _NO_COLOURS.search(path.stem) or not path.is_file():
                continue
            author, stated, note = notice.terms(name, by_name=True)  # one for a whole track may cover others' work
            licence = allowed(stated)
            if licence is not None and re.sub(r"(?i)public domain|published|by\b|[\d?()]", "", author).strip():
                yield Entry(name, package, version, author, licence, note), read_bytes(path)


PACKAGES = {"sweethome3d-furniture": _furniture, "supertuxkart-data": _textures}
"""Debian packages, and what yields their assets with their terms."""


def _is_inside(name: str) -> bool:
    return not name.startswith("/") and ".." not in name.split("/") and "\\" not in name and not name.endswith("/")


def take(name: str, tree: Path, package: str, version: str, folder: Path) -> list[Entry]:
    """Copy what is free to train on from an unpacked package, and write its manifest.

    Parameters
    ----------
    name : str
        One of `PACKAGES`.
    tree : Path
        Where it was unpacked.
    package, version : str
        Its source package.
    folder : Path
        Of the package's assets; made if missing. The manifest is written last.

    Raises
    ------
    FileError
        If a file cannot be read or written.
    """
    notice = read_bytes(tree / "usr/share/doc" / name / "copyright")
    entries = []
    for entry, content in PACKAGES[name](tree, package, version, Copyright(notice.decode("utf-8", "replace"))):
        target = folder / entry.file
        make_folder("folder", target.parent)
        if not target.exists():  # files have their names only when they are whole
            write_bytes(target, content)
        entries.append(entry)
    if not entries:
        raise FileError(f"package {name} {version} has no file that is free to train on where it used to have some")
    write_bytes(folder / "copyright", notice)
    write_bytes(folder / "CREDITS.md", _credits(entries).encode())
    manifest = {"package": package, "version": version, "files": [asdict(entry) for entry in entries]}
    write_bytes(folder / MANIFEST, json.dumps(manifest, indent=1, ensure_ascii=False).encode())
    return entries


def _credits(entries: Sequence[Entry]) -> str:
    lines = [f"# Assets of {entries[0].package} {entries[0].version}", ""]
    works = Counter((posixpath.dirname(e.file) or e.file, e.author, e.licence) for e in entries)
    lines += [f"- `{work}`: {author or 'author not stated'}, {licence}" for work, author, licence in sorted(works)]
    return "\n".join([*lines, "", "The full terms are in the file copyright beside this one.", ""])


def _run(words: Sequence[str], folder: Path) -> str:
    try:
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, env={**os.environ, "LC_ALL": "C"})
    except FileNotFoundError:
        raise StereokitError(f"{words[0]} is not there: this script needs a Debian system, or one derived") from None
    if done.returncode:
        reason = one_line((done.stderr.strip() or done.stdout.strip() or "no reason").splitlines()[-1])
        raise StereokitError(f"{' '.join(words[:2])} failed ({reason}); apt-get update may help")
    return done.stdout


def fetch(name: str, folder: Path) -> list[Entry]:
    """Download a package, take its assets, and remove the package; `folder` has all packages' folders."""
    work = folder / ".packages" / name
    make_folder("folder", work)
    tree = work / "tree"
    shutil.rmtree(tree, ignore_errors=True)  # of a run that was killed
    _run(["apt-get", "download", name], work)  # apt checks what is there already, and goes on with it
    archive = max(work.glob("*.deb"), key=lambda path: path.stat().st_mtime_ns, default=None)
    if archive is None:
        raise StereokitError(f"apt-get download {name} left no package in {str(work)!r}")
    source, version = (_run(["dpkg-deb", "-f", archive.name, key], work).strip() for key in ("Source", "Version"))
    tree.mkdir()
    _run(["dpkg-deb", "-x", archive.name, "tree"], work)
    entries = take(name, tree, source.partition(" ")[0] or name, version, folder / name)
    shutil.rmtree(work)
    return entries


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script; return the exit status."""
    parser = argparse.ArgumentParser(prog="assets", description=__doc__.split("\n\n")[0])
    parser.add_argument("folder", type=Path, help="where the assets go; made if missing")
    parser.add_argument("--package", action="append", choices=sorted(PACKAGES), help="only this one; may repeat")
    options = parser.parse_args(arguments)
    names = options.package or sorted(PACKAGES)
    try:
        if options.folder.exists() and not options.folder.is_dir():
            raise OptionError(f"folder must be a folder, got {str(options.folder)!r}")
        with progress(len(names)) as (_, step):
            for name in names:
                step(name, 0)
                manifest = options.folder / name / MANIFEST
                if manifest.exists():
                    with parsing(manifest, "manifest"):
                        entries = [Entry(**entry) for entry in json.loads(manifest.read_bytes())["files"]]
                else:
                    entries = fetch(name, options.folder)
                step(name)
                terms = ", ".join(
                    f"{count} {licence}" for licence, count in Counter(e.licence for e in entries).items()
                )
                print(f"{name} {entries[0].version}: {len(entries)} files ({terms})")
        shutil.rmtree(options.folder / ".packages", ignore_errors=True)
    except StereokitError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
