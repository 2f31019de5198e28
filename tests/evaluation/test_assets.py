"""Photographs and models from a folder: tiny files written here, by hand-computed values, and hostile ones."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest

pytest.importorskip("skimage")
pytest.importorskip("trimesh")

from stereokit.errors import OptionError, StereokitError
from stereokit.notices import collecting
from stereokit_evaluation.synthetic import assets as module
from stereokit_evaluation.synthetic import models
from stereokit_evaluation.synthetic.assets import MANIFEST, read_assets
from stereokit_evaluation.synthetic.generated import generate_pair, pair_name
from stereokit_evaluation.synthetic.meshes import heightfield, rotation
from stereokit_evaluation.synthetic.models import MOST, _simplified, read_model
from stereokit_evaluation.synthetic.render import Rig, render
from stereokit_evaluation.synthetic.sensors import Sensor
from stereokit_evaluation.synthetic.stage import Stage
from stereokit_evaluation.synthetic.things import model

PERFECT = Sensor(0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, contrast=0.5, quality=0)

# A box 2 wide, 4 high, 1 deep, y up, as other programs write it.
BOX = """mtllib box.mtl
usemtl coat
v 0 0 0
v 2 0 0
v 2 4 0
v 0 4 0
v 0 0 1
v 2 0 1
v 2 4 1
v 0 4 1
f 1 2 3 4
f 5 6 7 8
f 1 2 6 5
f 4 3 7 8
f 1 4 8 5
f 2 3 7 6
"""
# An upright square whose picture's corners are its own; (u, v) = (0, 0) is at the bottom left.
SQUARE = """mtllib square.mtl
usemtl board
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
f 1/1 2/2 3/3 4/4
"""


def nothing(name):
    raise KeyError(name)


def picture(path, image):
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())


def noise(seed=0, size=(160, 200)):
    return np.random.default_rng(seed).integers(0, 256, (*size, 3)).astype(np.uint8)


def glb(count=3, *, index=2, extra=None, data=None):
    """Return a GLB file of one triangle."""
    points = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 3, 0)
    body = points + struct.pack("<3H", 0, 1, index) + b"\0\0"
    header = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1], "roughnessFactor": 0.5}}],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 6},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        **(extra or {}),
    }  # fmt: skip
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


@pytest.fixture
def folder(tmp_path):
    """Return a folder with a box, a square with a picture, and a photograph."""
    base = tmp_path / "assets"
    (base / "shapes").mkdir(parents=True)
    (base / "shapes" / "box.obj").write_text(BOX)
    (base / "shapes" / "box.mtl").write_text("newmtl coat\nKd 0.5 0.5 0.5\nKs 0 0 0\nd 1\n")
    (base / "square.obj").write_text(SQUARE)
    (base / "square.mtl").write_text("newmtl board\nmap_Kd board.png\n")
    board = np.zeros((64, 64), np.uint8)
    board[:32, :32], board[:32, 32:], board[32:, :32], board[32:, 32:] = 255, 180, 120, 40
    picture(base / "board.png", board)
    picture(base / "photo.jpg", noise())
    return base


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "cache"


def test_a_model_is_centred_of_size_one_and_upside_down():
    box = read_model("box.obj", BOX.encode(), nothing)
    assert len(box.part) == 12 and box.points.shape == (36, 3)
    np.testing.assert_allclose(np.ptp(box.points, axis=0), [0.5, 1.0, 0.25], atol=1e-6)
    np.testing.assert_allclose(box.points.max(axis=0), [0.25, 0.5, 0.125], atol=1e-6)
    outward = (box.normals * box.points).sum(axis=1)
    assert (np.abs(box.normals).max(axis=1) > 0.999).all() and (np.abs(outward) > 0.1).all()  # sides stay flat
    triangle = read_model("tip.obj", b"v 0 0 5\nv 1 0 5\nv 0 3 7\nf 1 2 3\n", nothing).points
    top = triangle[triangle[:, 1].argmin()]  # y points down: the corner at 3 is the highest
    assert top[1] == pytest.approx(-0.5) and top[2] == triangle[:, 2].min()  # z away: the corner at 7 is the nearest


def test_materials_become_brightness_and_lengths(folder, cache):
    own = read_assets(folder, cache)
    assert own.models == ("shapes/box.obj", "square.obj") and own.photographs == ("photo.jpg",)  # the board is small
    box, square = own.model(0), own.model(1)
    assert box.looks.tolist() == [[pytest.approx(0.5**2.2, rel=0.01), 0, 0, -1, 1]]
    np.testing.assert_allclose(np.ptp(box.uv, axis=0).max(), 1.0, atol=1e-6)  # lengths on the surface
    assert square.looks[0, 3:].tolist() == [0, pytest.approx(1.0)]  # one repeat covers the square
    corner = square.points[:, :2].argmin(axis=0)
    assert square.uv[corner[0], 0] == 0 and square.uv[corner[1], 1] == 0  # left, and top
    linear = [round(255 * (value / 255) ** 2.2) for value in (255, 180, 120, 40)]
    assert [int(square.pictures[0, y, x]) for y in (100, 400) for x in (100, 400)] == linear


def test_a_glb_is_read():
    triangle = read_model("a.glb", glb(), nothing)
    np.testing.assert_allclose(np.ptp(triangle.points, axis=0), [1 / 3, 1, 0], atol=1e-6)
    assert triangle.looks[0, 0] == pytest.approx(0.9) and triangle.looks[0, 2] == pytest.approx(0.4)


def test_a_node_that_is_its_own_child_is_read_once():
    assert len(read_model("loop.glb", glb(extra={"nodes": [{"mesh": 0, "children": [0]}]}), nothing).part) == 1


def test_parts_that_let_light_through_and_pictures_with_holes(tmp_path, folder, cache):
    (folder / "shapes" / "box.mtl").write_text("newmtl coat\nKd 1 1 1\nd 0.25\n")
    cut = np.full((64, 64, 4), 200, np.uint8)
    cut[:, 32:, 3] = 0
    picture(folder / "board.png", cut)
    own = read_assets(folder, cache)
    assert own.model(0).looks[0, 1] == pytest.approx(0.75)
    holes = own.model(1).holes[0]
    assert holes.shape == (256, 256) and holes[:, :120].all() and not holes[:, 136:].any()


def test_a_model_of_many_triangles_is_simplified():
    rows = np.linspace(0, 1, 102)
    field = heightfield(np.outer(np.sin(3 * rows), np.cos(2 * rows)) * 0.2, 1.0, 1.0)
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in field.points)
    text += "".join(f"f {a} {b} {c}\n" for a, b, c in field.faces + 1)
    assert len(field.faces) == 2 * 101 * 101 > MOST
    simple = read_model("field.obj", text.encode(), nothing)
    assert MOST / 8 < len(simple.part) <= MOST
    np.testing.assert_allclose(np.ptp(simple.points, axis=0), np.ptp(field.points, axis=0), atol=0.02)
    remaining, points = _simplified(np.array([[[-0.4, 0, 0], [0.4, 0, 0], [0, 0.4, 0]]] * (MOST + 1)))
    assert remaining.tolist() == [0] and points.shape == (1, 3, 3)  # copies of one triangle are one


def stand(own, size, position, turn, seed=0):
    stage = Stage(np.random.default_rng(seed), plain=0.0, field_of_view=1.0, assets=own)
    stage.light = {"ambient": 1.0}
    model(stage, size, np.array(position, float), turn)
    return stage


def test_an_upright_model_stands_and_others_are_centred(folder, cache):
    (folder / "square.obj").unlink()
    own = read_assets(folder, cache)
    for turn in (rotation(0.0), rotation(1.1)):
        points = stand(own, 2.0, (0.5, -1.0, 6), turn)._parts[0][0].points
        assert points[:, 1].max() == pytest.approx(0.0) and np.ptp(points[:, 1]) == pytest.approx(2.0)
        assert (points.max(axis=0) + points.min(axis=0))[[0, 2]] / 2 == pytest.approx([0.5, 6.0])
    lying = stand(own, 2.0, (0, 0, 6), rotation(0, 0, np.pi / 2))._parts[0][0].points
    np.testing.assert_allclose((lying.max(axis=0) + lying.min(axis=0)) / 2, [0, 0, 6], atol=1e-6)
    assert np.ptp(lying, axis=0) == pytest.approx([2.0, 1.0, 0.5])


def test_a_picture_lies_on_its_model_as_it_was_drawn(folder, cache):
    (folder / "shapes" / "box.obj").unlink()
    own = read_assets(folder, cache)
    seed = next(seed for seed in range(20) if stand(own, 2.0, (0, 0, 2.5), rotation(0.0), seed)._pictures)
    stage = stand(own, 2.0, (0, 0, 2.5), rotation(0.0), seed)  # a quarter of the models is painted anew
    stage._materials[-1][10:] = 0  # no detail on top, no gloss
    dark = replace(PERFECT, exposure=0.15, contrast=1.0)
    pair = render(stage, Rig(64, 64, 6.0, 1.0, 0.0, 0.0, dark, dark), np.random.default_rng(0))
    inside = pair.truth > 0
    columns, rows = np.flatnonzero(inside.any(axis=0)), np.flatnonzero(inside.any(axis=1))
    quarters = [np.linspace(axis[0], axis[-1], 5).round().astype(int)[[1, 3]] for axis in (columns, rows)]
    grey = [float(pair.left[y, x]) for y in quarters[1] for x in quarters[0]]
    linear = np.array([(value / 255) ** 2.2 for value in (255, 180, 120, 40)])
    shown = np.array(grey) / grey[0]
    # a camera of gamma 1 shows brightness as it is; that of a material ends at 0.01
    np.testing.assert_allclose(shown, np.maximum(linear, 0.01) / linear[0], atol=0.03)


@pytest.mark.parametrize("kind", ["room", "hall", "pile", "flying", "garden", "road", "closeup"])
def test_pairs_depend_on_seed_and_assets_alone(kind, folder, cache):
    own = read_assets(folder, cache)
    plain = generate_pair(5, kind, size=(96, 64))
    first = generate_pair(5, kind, size=(96, 64), assets=own)
    module._model.cache_clear()
    again = generate_pair(5, kind, size=(96, 64), assets=read_assets(folder, cache.with_name("other")))
    for name in ("left", "right", "truth", "seen"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()
    assert first.left.tobytes() != plain.left.tobytes()
    assert first.truth.max() <= 24 + 1e-4 and np.isfinite(first.truth).all()


def test_photographs_join_the_textures(folder, cache):
    for path in (*folder.glob("shapes/*"), *folder.glob("square.*"), folder / "board.png"):
        path.unlink()
    own = read_assets(folder, cache)
    stage = Stage(np.random.default_rng(0), assets=own)
    for _ in range(20):
        stage.slot("photograph")
    assert 1 <= sum(kind == "photograph of the assets" for kind, _ in stage._textures) <= 4
    bank = Stage(np.random.default_rng(0))
    for _ in range(20):
        bank.slot("photograph")
    assert not bank._pictures


def test_the_name_of_a_pair_has_the_digest_of_the_assets(folder, cache):
    own = read_assets(folder, cache)
    assert pair_name(3, "room", own) == pair_name(3, "room").replace(".npz", f"-{own.digest}.npz")
    assert pair_name(3, "street", own) == pair_name(3, "street")  # which shows none
    assert read_assets(folder, cache).digest == own.digest
    (folder / "photo.jpg").rename(folder / "other.jpg")
    renamed = read_assets(folder, cache).digest
    picture(folder / "other.jpg", noise(1))
    assert len({own.digest, renamed, read_assets(folder, cache).digest}) == 3


def test_files_are_read_once_and_again_when_they_or_their_parts_change(folder, cache, monkeypatch):
    real, names = module.read_model, []

    def counted(name, data, fetch):
        names.append(name)
        return real(name, data, fetch)

    monkeypatch.setattr(module, "read_model", counted)
    read_assets(folder, cache)
    read_assets(folder, cache)
    assert names == ["shapes/box.obj", "square.obj"]
    picture(folder / "board.png", noise())
    assert read_assets(folder, cache).model(1).pictures.std() > 20
    assert names == ["shapes/box.obj", "square.obj", "square.obj"]


def test_no_file_outside_of_the_folder_is_read(folder, cache):
    picture(folder.parent / "secret.png", noise())
    (folder / "square.mtl").write_text("newmtl board\nmap_Kd ../secret.png\n")
    assert read_assets(folder, cache).model(1).looks[0, 3] == -1
    (folder / "square.mtl").write_text(f"newmtl board\nmap_Kd {folder.parent / 'secret.png'}\n")
    assert read_assets(folder, cache).model(1).looks[0, 3] == -1


def hostile(name):
    return {
        "cut.glb": glb()[:-30],
        "tiny.glb": b"glTF",
        "text.glb": b"Lorem ipsum dolor sit amet",
        "large.glb": glb(4_000_000_000),
        "more.glb": glb(5000),
        "index.glb": glb(index=7),
        "draco.glb": glb(extra={"extensionsRequired": ["KHR_draco_mesh_compression"]}),
        "scene.gltf": b'{"asset": {"version": "2.0"}, "meshes": [',
        "lines.obj": b"v 0 0 0\nv 1 0 0\nl 1 2\n",
        "empty.obj": b"",
        "nan.obj": b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n",
        "point.obj": b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n",
        "corner.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
        "text.png": b"this is no picture",
        "text.jpg": b"",
    }[name]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("cut.glb", "it ends after"),
        ("tiny.glb", "does not begin like a GLB"),
        ("text.glb", "does not begin like a GLB"),
        ("large.glb", "4000000003 values, more than 12000000"),
        ("more.glb", "more.glb"),
        ("index.glb", "index.glb"),
        ("draco.glb", "glTF extension 'KHR_draco_mesh_compression'"),
        ("scene.gltf", "scene.gltf"),
        ("lines.obj", "lines.obj"),
        ("empty.obj", "empty.obj"),
        ("nan.obj", "nan.obj"),
        ("point.obj", "no triangles that can be seen"),
        ("corner.obj", "corner.obj"),
        ("text.png", "text.png"),
        ("text.jpg", "text.jpg"),
    ],
)
def test_what_cannot_be_used_is_left_out_with_one_line(name, reason, folder, cache):
    (folder / name).write_bytes(hostile(name))
    for _ in range(2):  # the second time from the cache
        with collecting() as lines:
            own = read_assets(folder, cache)
        assert len(lines) == 1 and lines[0].startswith("assets: left out: ") and reason in lines[0], lines
        assert "\n" not in lines[0] and len(lines[0]) < 400
        assert name not in (*own.models, *own.photographs) and len(own.models) == 2


def test_a_model_of_too_many_triangles_is_left_out(folder, cache, monkeypatch):
    monkeypatch.setattr(models, "READABLE", 5)
    with collecting() as lines:
        assert read_assets(folder, cache).models == ("square.obj",)
    assert len(lines) == 1 and "box.obj" in lines[0] and "more than 5" in lines[0]


def test_a_folder_without_assets_is_refused(tmp_path, folder, cache, monkeypatch):
    with pytest.raises(OptionError, match=r"assets must be a folder, got .*none"):
        read_assets(tmp_path / "none", cache)
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "notes.txt").write_text("nothing")
    picture(empty / "small.png", noise(size=(20, 20)))
    picture(empty / "flat.png", np.full((300, 300), 7, np.uint8))
    (empty / ".hidden.obj").write_text(BOX)
    with pytest.raises(OptionError, match=r"assets must hold photographs .* got none in"):
        read_assets(empty, cache)
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)
    with pytest.raises(StereokitError, match=r"trimesh, which is not installed: pip install 'stereokit\[assets\]'"):
        read_assets(folder, cache)


def test_manifests_name_the_licences(folder, cache):
    (folder / "shapes" / MANIFEST).write_text(json.dumps({"files": [{"file": "box.obj", "licence": "CC0"}]}))
    assert read_assets(folder, cache).notes == {
        "digest": read_assets(folder, cache).digest,
        "photographs": 1,
        "models": 2,
        "licences": {"CC0": 1, "not stated": 2},
    }
    (folder / MANIFEST).write_text('{"files": [3]}')
    with pytest.raises(StereokitError, match=r"manifest\.json must be"):
        read_assets(folder, cache)
