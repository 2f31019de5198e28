"""Assets out of Debian packages: terms by their copyright files, and a run without a network."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

from stereokit.errors import StereokitError
from stereokit_evaluation.commands import assets
from stereokit_evaluation.commands.assets import Copyright, allowed, main, take

NOTICE = """Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/

Files: *
Copyright: 2006 The team
License: GPL-3+

Files: data/textures/wall.jpg
 data/textures/rock_nm.jpg
 data/textures/rock?.png
Copyright:
 2010 A. Mason
 2011 B. Smith
License: CC-BY-3.0
Comment: From a quarry

Files: data/textures/sky.png
Copyright: 2012 C. Cloud
License: CC-BY-SA-3.0

Files: data/textures/both.png
Copyright: 2012 C. Cloud
License: CC-BY-SA-4.0 or CC0

Files: data/textures/nobody.png
Copyright: (Public Domain)
License: public-domain

Files: data/tracks/hill/*
Copyright: 2015 D. Hill
License: CC-BY-4.0

Files: data/tracks/hill/log.png
Copyright: 2013 E. Forest
License: CC0-1.0

Files: Chairs/*
Copyright: 2009 F. Joiner
License: CC-BY-3.0-USA

License: CC-BY-3.0
 The text of the licence.
 .
 Files: are named in it too.
"""

CATALOGUE = """id=chairs
model#1=/chairs/stool/stool.obj
creator#1=G. Turner
model#2=/chairs/bench/bench.obj
creator#2=
"""

RELEASED = """Thank you for downloading "Set" by {author}
Released under
{licence}
Downloaded from somewhere
You MUST give credit to {author}.
"""


@pytest.mark.parametrize(
    ("stated", "licence"),
    [
        ("CC0", "CC0"), ("CC0-1.0", "CC0-1.0"), ("public-domain", "public-domain"), ("CC-BY-3.0-USA", "CC-BY-3.0-USA"),
        ("CC-BY-SA-4.0 or CC-BY-3.0", "CC-BY-3.0"), ("CC-BY-4.0 and CC-BY-3.0", "CC-BY-4.0 and CC-BY-3.0"),
        ("CC-BY-SA-3.0", None), ("CC-BY-NC-4.0", None), ("CC-BY-ND-2.0", None), ("GPL-2+", None), ("GFDL-1.3", None),
        ("CC0 and GPL-3", None), ("CC0, GPL-3", None), ("MIT", None), ("CC-BY", None), ("", None), ("CC00", None),
    ],
)  # fmt: skip
def test_licences_that_are_free_to_train_on(stated, licence):
    assert allowed(stated) == licence


def test_the_last_paragraph_that_fits_counts():
    notice = Copyright(NOTICE)
    assert notice.terms("data/textures/wall.jpg") == ("2010 A. Mason 2011 B. Smith", "CC-BY-3.0", "From a quarry")
    assert notice.terms("data/textures/rock7.png")[1] == "CC-BY-3.0"
    assert notice.terms("data/textures/other.jpg")[1] == "GPL-3+"
    assert notice.terms("data/tracks/hill/a/b.png")[0] == "2015 D. Hill"
    assert notice.terms("data/tracks/hill/a/b.png", by_name=True) == ("", "", "")
    assert notice.terms("data/tracks/hill/log.png", by_name=True)[1] == "CC0-1.0"
    assert Copyright("nothing of that kind").terms("a") == ("", "", "")


@pytest.mark.parametrize(
    ("text", "terms"),
    [
        (RELEASED.format(author="Ann", licence="Creative Commons Zero (Public Domain)"), ("Ann", "CC0")),
        (RELEASED.format(author="Ann Lee", licence="Creative Commons Attribution 3.0"), ("Ann Lee", "CC-BY-3.0")),
        (RELEASED.format(author="Ann", licence="Creative Commons Attribution-ShareAlike 3.0"), ("Ann", "")),
        (RELEASED.format(author="Ann", licence="Creative Commons Attribution 3.0 NonCommercial"), ("Ann", "")),
        (RELEASED.format(author="Ann", licence="GPL 3.0"), ("Ann", "")),
        ("<p>This file has been released by <b>ann</b> under the following license: <a>Creative Commons Attribution 3.0"
         "</a> You can</p>", ("ann", "CC-BY-3.0")),
        ("no terms", ("", "")),
    ],
)  # fmt: skip
def test_terms_beside_a_model(text, terms):
    assert assets._own_terms(text) == terms


def tree(base: Path) -> Path:
    """Return an unpacked package of each kind."""
    root = base / "tree"
    for name in assets.PACKAGES:
        (root / "usr/share/doc" / name).mkdir(parents=True)
        (root / "usr/share/doc" / name / "copyright").write_text(NOTICE)
    for name in (
        "textures/wall.jpg", "textures/rock_nm.jpg", "textures/rock1.png", "textures/sky.png", "textures/both.png",
        "textures/nobody.png", "textures/other.jpg", "textures/wall.txt", "tracks/hill/log.png", "tracks/hill/mud.png",
    ):  # fmt: skip
        path = root / "usr/share/games/supertuxkart/data" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    folder = root / "usr/share/sweethome3d/furniture"
    folder.mkdir(parents=True)
    with zipfile.ZipFile(folder / "Chairs.sh3f", "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", CATALOGUE)
        archive.writestr("LICENSE.TXT", "LICENSE")
        archive.writestr("chairs/stool.png", "an icon")
        for model, licence in (
            ("stool", ""),
            ("bench", "Creative Commons Zero"),
            ("sofa", "Attribution-ShareAlike 3.0"),
        ):
            archive.writestr(f"chairs/{model}/{model}.obj", model)
            archive.writestr(f"chairs/{model}/{model}.mtl", model)
            archive.writestr(f"chairs/{model}/cloth.JPG", model)
            if licence:
                archive.writestr(f"chairs/{model}/a - License.html", RELEASED.format(author="H. Wood", licence=licence))
        archive.writestr("chairs/../../../evil.obj", "evil")
    return root


def test_only_what_is_free_and_shows_a_surface_is_taken(tmp_path):
    root = tree(tmp_path)
    out = tmp_path / "out" / "kart"
    entries = take("supertuxkart-data", root, "supertuxkart", "1.4", out)
    assert {entry.file: entry.licence for entry in entries} == {
        "data/textures/both.png": "CC0",
        "data/textures/wall.jpg": "CC-BY-3.0",
        "data/tracks/hill/log.png": "CC0-1.0",
    }
    files = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
    assert files == sorted([*(entry.file for entry in entries), "CREDITS.md", "copyright", "manifest.json"])
    assert (out / "data/textures/wall.jpg").read_bytes() == b"textures/wall.jpg"
    assert json.loads((out / "manifest.json").read_text())["files"][1] == {
        "file": "data/textures/wall.jpg", "package": "supertuxkart", "version": "1.4", "licence": "CC-BY-3.0",
        "author": "2010 A. Mason 2011 B. Smith", "note": "From a quarry",
    }  # fmt: skip
    assert "- `data/textures`: 2010 A. Mason 2011 B. Smith, CC-BY-3.0" in (out / "CREDITS.md").read_text()


def test_models_are_taken_by_the_terms_of_library_and_model(tmp_path):
    entries = take("sweethome3d-furniture", tree(tmp_path), "sweethome3d-furniture", "1.8-1", tmp_path / "out")
    assert {entry.file: (entry.author, entry.licence) for entry in entries if entry.file.endswith(".obj")} == {
        "Chairs/chairs/stool/stool.obj": ("G. Turner", "CC-BY-3.0-USA"),
        "Chairs/chairs/bench/bench.obj": ("H. Wood", "CC0"),
    }
    assert sorted(path.name for path in (tmp_path / "out/Chairs/chairs/bench").iterdir()) == [
        "bench.mtl", "bench.obj", "cloth.JPG",
    ]  # fmt: skip
    assert not list(tmp_path.rglob("evil.obj"))


def test_a_package_that_changed_beyond_recognition_is_refused(tmp_path):
    root = tree(tmp_path)
    (root / "usr/share/doc/supertuxkart-data/copyright").write_text("Files: *\nLicense: GPL-3\n")
    with pytest.raises(StereokitError, match="no file that is free to train on"):
        take("supertuxkart-data", root, "supertuxkart", "2", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.fixture
def debian(tmp_path, monkeypatch):
    """Put in place of Debian's tools what answers from a folder; return what was run."""
    root, calls = tree(tmp_path / "debian"), []

    def run(words, folder):
        calls.append(words[:2] if words[0] == "apt-get" else words[:2] + words[3:])
        if words[0] == "apt-get":
            (folder / f"{words[2]}_1_all.deb").write_bytes(b"")
        elif words[1] == "-f":
            return {"Source": "supertuxkart (1.3)" if "kart" in words[2] else "", "Version": "1"}[words[3]] + "\n"
        else:
            (folder / "tree").rmdir()
            (folder / "tree").symlink_to(root)
        return ""

    monkeypatch.setattr(assets, "_run", run)
    return calls


def test_a_stopped_run_goes_on_and_a_finished_one_needs_no_network(tmp_path, debian, monkeypatch, capsys):
    real, count = assets.write_bytes, 0

    def stopped(path, data):
        nonlocal count
        count += 1
        if count == 4:
            raise KeyboardInterrupt
        real(path, data)

    out = tmp_path / "out"
    monkeypatch.setattr(assets, "write_bytes", stopped)
    assert main([str(out)]) == 130
    assert not list(out.rglob("manifest.json"))
    for link in out.rglob("tree"):
        link.unlink()
    monkeypatch.setattr(assets, "write_bytes", real)
    assert main([str(out)]) == 0
    assert (out / "supertuxkart-data/manifest.json").exists() and not (out / ".packages").exists()
    version = json.loads((out / "supertuxkart-data/manifest.json").read_text())
    assert (version["package"], version["version"]) == ("supertuxkart", "1")
    first = capsys.readouterr().out
    assert "supertuxkart-data 1: 3 files (1 CC0, 1 CC-BY-3.0, 1 CC0-1.0)" in first
    debian.clear()
    assert main([str(out)]) == 0 and not debian
    assert capsys.readouterr().out == first


def test_mistakes_end_with_one_line(tmp_path, capsys, monkeypatch):
    (tmp_path / "file").write_text("")
    assert main([str(tmp_path / "file")]) == 2
    assert capsys.readouterr().err.startswith("error: folder must be a folder, got ")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main([str(tmp_path / "out"), "--package", "supertuxkart-data"]) == 2
    assert "apt-get is not there: this script needs a Debian system" in capsys.readouterr().err
    tool = tmp_path / "apt-get"
    tool.write_text("#!/bin/sh\necho 'E: Unable to locate package' >&2\nexit 100\n")
    tool.chmod(0o755)
    assert main([str(tmp_path / "out"), "--package", "supertuxkart-data"]) == 2
    error = capsys.readouterr().err
    assert "apt-get download failed (E: Unable to locate package); apt-get update may help" in error
    assert error.count("\n") == 1
