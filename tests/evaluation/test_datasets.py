"""Every layout that the data sets read, built small on disk, and the frames that a selection picks."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from stereokit.errors import FileError, OptionError, UnknownNameError
from stereokit_evaluation.data import datasets
from stereokit_evaluation.data.frame import Benchmark, Frame, select_frames

DATA = Path(os.environ.get("STEREOKIT_DATA", Path(__file__).parents[2].parent / "shared" / "data"))
NAN = np.nan
TRUTH = np.float32([[1.5, NAN, 2.0], [3.0, 4.0, NAN]])


def write(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".pfm":
        rows = np.nan_to_num(image, nan=np.inf)[::-1].astype("<f4")
        path.write_bytes(f"Pf\n{image.shape[1]} {image.shape[0]}\n-1.0\n".encode() + rows.tobytes())
    else:
        assert cv2.imwrite(str(path), np.asarray(image))


def picture(value, channels=3):
    return np.full((2, 3, channels) if channels > 1 else (2, 3), value, np.uint8)


def kitti_png(disparity):
    return np.nan_to_num(disparity * 256, nan=0).astype(np.uint16)


@pytest.fixture
def kitti(tmp_path):
    training = tmp_path / "training"
    for name in ("000007_10", "000003_10"):
        write(training / "image_2" / f"{name}.png", picture([30, 20, 10]))
        write(training / "image_3" / f"{name}.png", picture(5))
        write(training / "disp_occ_0" / f"{name}.png", kitti_png(TRUTH))
    write(training / "image_2" / "000003_11.png", picture(9))
    write(training / "disp_noc_0" / "000003_10.png", kitti_png(TRUTH / 2))
    write(training / "obj_map" / "000003_10.png", np.uint8([[0, 1, 2], [0, 0, 3]]))
    return tmp_path


def test_kitti2015(kitti):
    for root in (kitti, kitti / "training", str(kitti)):
        frames = datasets.kitti2015(root)
        assert [frame.name for frame in frames] == ["000003_10", "000007_10"]
    first, second = frames
    np.testing.assert_array_equal(first.load_left(), picture([10, 20, 30]))  # RGB
    assert first.load_right(gray=True).shape == (2, 3)
    np.testing.assert_array_equal(first.load_noc(), TRUTH / 2)
    np.testing.assert_array_equal(first.load_occ(), TRUTH)
    np.testing.assert_array_equal(first.load_objects(), [[0, 1, 2], [0, 0, 3]])
    assert first.load_occ().dtype == np.float32
    assert second.load_noc() is None and second.load_objects() is None
    np.testing.assert_array_equal(second.load_occ(), TRUTH)
    assert first.max_disparity == 128


def test_nothing_is_read_before_it_is_asked_for(kitti):
    broken = kitti / "training" / "disp_noc_0" / "000007_10.png"
    broken.write_bytes(b"not a picture")
    (kitti / "training" / "image_3" / "000007_10.png").unlink()
    frame = datasets.kitti2015(kitti)[1]
    frame.load_left()
    for load in (frame.load_right, frame.load_noc):
        with pytest.raises(FileError):
            load()


def test_a_frame_of_which_only_the_truth_is_left_is_listed(kitti):
    write(kitti / "training" / "disp_noc_0" / "000001_10.png", kitti_png(TRUTH))
    assert [frame.name[:6] for frame in datasets.kitti2015(kitti)] == ["000001", "000003", "000007"]


@pytest.mark.parametrize("pair", [("image_0", "image_1"), ("colored_0", "colored_1"), ("colour_0", "colour_1")])
def test_kitti2012(tmp_path, pair):
    write(tmp_path / pair[0] / "000000_10.png", picture(7, channels=1))
    write(tmp_path / pair[1] / "000000_10.png", picture(8, channels=1))
    write(tmp_path / "disp_noc" / "000000_10.png", kitti_png(TRUTH))
    (frame,) = datasets.kitti2012(tmp_path)
    assert (frame.load_left()[0, 0], frame.load_right()[0, 0]) == (7, 8)
    np.testing.assert_array_equal(frame.load_noc(), TRUTH)
    assert frame.load_occ() is None


def scene_8bit(folder, left, right, truth, ending=".png", map_ending=".png"):
    write(folder / f"{left}{ending}", picture(1))
    write(folder / f"{right}{ending}", picture(2))
    write(folder / f"{truth}{map_ending}", np.uint8([[0, 24, 48], [96, 0, 255]]))


@pytest.mark.parametrize(
    ("folder", "names", "endings", "levels", "disparities"),
    [
        ("sawtooth", ("im2", "im6", "disp2"), (".ppm", ".pgm"), 8, 32),
        ("Cones", ("im2", "im6", "disp2"), (".ppm", ".pgm"), 4, 64),
        ("2003/other", ("im2", "im6", "disp2"), (".png", ".png"), 4, 64),
        ("2005/Art", ("view1", "view5", "disp1"), (".png", ".png"), 3, 96),
    ],
)
def test_middlebury_8bit(tmp_path, folder, names, endings, levels, disparities):
    scene_8bit(tmp_path / folder, *names, *endings)
    (frame,) = datasets.middlebury(tmp_path)
    assert frame.name == folder and frame.max_disparity == disparities
    assert (frame.load_left()[0, 0, 0], frame.load_right()[0, 0, 0]) == (1, 2)
    raw = np.float32([[NAN, 24, 48], [96, NAN, 255]])
    np.testing.assert_array_equal(frame.load_occ(), raw / np.float32(levels))
    assert frame.load_noc() is None
    write(tmp_path / folder / "mask_nonocc.png", np.dstack([np.uint8([[255, 255, 0], [128, 255, 255]])] * 3))
    (frame,) = datasets.middlebury(tmp_path)
    seen = np.float32([[NAN, 24, NAN], [NAN, NAN, 255]])
    np.testing.assert_array_equal(frame.load_noc(), seen / np.float32(levels))


def test_a_larger_middlebury_edition_is_refused(tmp_path):
    scene_8bit(tmp_path / "teddy", "im2", "im6", "disp2")
    write(tmp_path / "teddy" / "disp2.png", np.ones((2, 900), np.uint8))
    (frame,) = datasets.middlebury(tmp_path)
    with pytest.raises(FileError, match="at most 450 px wide at 4 levels a pixel, got 900"):
        frame.load_occ()


@pytest.mark.parametrize("make", [datasets.middlebury, datasets.eth3d])
@pytest.mark.parametrize("truth", ["disp0GT.pfm", "disp0.pfm"])
def test_pairs_with_calibration(tmp_path, make, truth):
    scene = tmp_path / "deep" / "room"
    write(scene / "im0.png", picture(1))
    write(scene / "im1.png", picture(2))
    (frame,) = make(tmp_path)
    assert frame.load_occ() is None and frame.load_noc() is None and frame.max_disparity is None
    write(scene / truth, TRUTH)
    write(scene / "mask0nocc.png", np.uint8([[255, 255, 128], [0, 255, 255]]))
    (scene / "calib.txt").write_text("cam0=[1 0 2; 0 1 3; 0 0 1]\nndisp=70\nisint=0\n")
    (frame,) = make(tmp_path)
    assert (frame.name, frame.max_disparity) == ("deep/room", 70 if make is datasets.middlebury else 64)
    assert frame.benchmark == Benchmark(make.__name__) and frame.scene == "deep/room"
    np.testing.assert_array_equal(frame.load_occ(), TRUTH)
    np.testing.assert_array_equal(frame.load_noc(), np.float32([[1.5, NAN, NAN], [NAN, 4.0, NAN]]))
    assert make(scene)[0].name == "room"


def test_pairs_of_one_scene_and_whole_truth(tmp_path):
    for name in ("H/PianoL", "H/Piano", "H/Teddy", "H/Middle"):
        write(tmp_path / name / "im0.png", picture(1))
        (tmp_path / name / "calib.txt").write_text(f"isint={int(name == 'H/Teddy')}\nndisp=128\n")
    frames = {frame.name: frame for frame in datasets.middlebury(tmp_path)}
    assert {name: frame.scene for name, frame in frames.items()} == {
        "H/PianoL": "H/Piano", "H/Piano": "H/Piano", "H/Teddy": "H/Teddy", "H/Middle": "H/Middle",
    }  # fmt: skip
    assert [name for name, frame in frames.items() if frame.benchmark.integer] == ["H/Teddy"]
    for name in ("delivery_area_1l", "delivery_area_3s", "forest_2s", "storage_room_2_1l"):
        write(tmp_path / "two" / name / "im0.png", picture(1))
    scenes = {frame.name: frame.scene for frame in datasets.eth3d(tmp_path / "two")}
    assert scenes == {
        "delivery_area_1l": "delivery_area", "delivery_area_3s": "delivery_area", "forest_2s": "forest",
        "storage_room_2_1l": "storage_room_2",
    }  # fmt: skip


def test_drives_of_kitti(tmp_path):
    for index in (0, 1, 9, 10, 14):
        write(tmp_path / "training" / "image_2" / f"{index:06d}_10.png", picture(1))
    blocks = [frame.scene for frame in datasets.kitti2015(tmp_path)]
    assert blocks == ["000000-000009"] * 3 + ["000010-000019"] * 2
    lines = ["2011_09_26 2011_09_26_drive_0005_sync 0000000010", "", *["d drive_7 1"] * 9]
    (tmp_path / "devkit" / "mapping").mkdir(parents=True)
    (tmp_path / "devkit" / "mapping" / "train_mapping.txt").write_text("\n".join(lines))
    drives = [frame.scene for frame in datasets.kitti2015(tmp_path)]
    assert drives == ["2011_09_26_drive_0005_sync", "000001_10", "drive_7", "drive_7", "000010-000019"]


def test_a_scene_of_2001_with_all_its_views_is_one_frame(tmp_path):
    scene_8bit(tmp_path / "venus", "im2", "im6", "disp2")
    for view in (0, 1):
        write(tmp_path / "venus" / f"im{view}.png", picture(0))
    assert [frame.name for frame in datasets.middlebury(tmp_path)] == ["venus"]


@pytest.mark.parametrize("kind", ["disparity", "disp_occ"])
@pytest.mark.parametrize("ending", [".png", ".pfm", ".npy"])
def test_plain_folder(tmp_path, kind, ending):
    for name in ("b", "a"):
        write(tmp_path / "left" / f"{name}.png", picture(1))
    write(tmp_path / "right" / "a.ppm", picture(2))
    path = tmp_path / kind / f"a{ending}"
    if ending == ".npy":
        path.parent.mkdir()
        np.save(path, TRUTH)
    else:
        write(path, kitti_png(TRUTH) if ending == ".png" else TRUTH)
    a, b = datasets.folder(tmp_path)
    assert (a.name, b.name) == ("a", "b")
    assert a.load_right()[0, 0, 0] == 2
    np.testing.assert_array_equal(a.load_occ(), TRUTH)
    assert a.load_noc() is None and b.load_occ() is None
    with pytest.raises(FileError, match=r"right.b\.png"):
        b.load_right()


@pytest.mark.parametrize("name", sorted(datasets.DATASETS))
def test_a_root_without_frames_says_what_was_expected(tmp_path, name):
    with pytest.raises(FileError, match=r"root has no .* frames, got .*; expected ") as caught:
        datasets.load_frames(name, tmp_path)
    assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(FileError, match="root must be a folder, got"):
        datasets.load_frames(name, tmp_path / "nowhere")
    with pytest.raises(OptionError, match=f"root must name the folder of data set '{name}', got none"):
        datasets.load_frames(name)


def test_an_unknown_data_set_is_named_with_its_neighbour():
    with pytest.raises(UnknownNameError, match="did you mean 'kitti2015'"):
        datasets.load_frames("kitti2105", ".")


def frames_named(*names):
    return [Frame(name, Path("l"), Path("r")) for name in names]


@pytest.mark.parametrize(
    ("which", "expected"),
    [
        ("0", ["000000_10"]),
        ("2-9,11-40", ["000003_10", "000034_10"]),
        ("34,0-3", ["000000_10", "000003_10", "000034_10"]),
        (" 3 , 3", ["000003_10"]),
        ("000034_10", ["000034_10"]),
        ("010", ["000010_10"]),
        (None, ["000000_10", "000003_10", "000010_10", "000034_10"]),
    ],
)
def test_select_by_number(which, expected):
    frames = frames_named("000000_10", "000003_10", "000010_10", "000034_10")
    assert [frame.name for frame in select_frames(frames, which)] == expected


def test_select_by_name():
    frames = frames_named("2003/cones", "2003/teddy", "2006/Aloe", "a-b", "scene_004")
    assert [f.name for f in select_frames(frames, "teddy,2006/Aloe")] == ["2003/teddy", "2006/Aloe"]
    assert [f.name for f in select_frames(frames, "a-b,4")] == ["a-b", "scene_004"]


@pytest.mark.parametrize("which", ["", "1,", "50", "5-3", "-3", "1-", "x", "cones2", "1-2-3", "\u0663"])
def test_select_refuses_what_matches_nothing(which):
    with pytest.raises(OptionError, match="frames must be"):
        select_frames(frames_named("000001_10", "000005_10", "cones"), which)


def test_images_from_functions_turn_grey():
    frame = Frame("made", lambda: picture([100, 0, 0]), lambda: picture(4, channels=1))
    assert frame.load_left(gray=True)[0, 0] == 30  # 0.299 of red
    assert frame.load_left().shape == (2, 3, 3)
    assert frame.load_right(gray=True)[0, 0] == 4


def test_scenes_are_adapted_and_drawn_once(monkeypatch):
    drawn = []

    def generate(index, width, height):
        drawn.append(index)
        occ = np.full((height, width), 5.0 + index, np.float32)
        noc = occ.copy()
        noc[:, :5] = np.nan
        image = np.full((height, width), index, np.uint8)
        return SimpleNamespace(left=image, right=image + 1, occ=occ, noc=noc, objects=image)

    monkeypatch.setitem(sys.modules, "stereokit_evaluation.synthetic.scenes", SimpleNamespace(generate=generate))
    datasets._scene.cache_clear()
    frames = datasets.load_frames("scenes", count=3)
    assert [frame.name for frame in frames] == ["scene_000", "scene_001", "scene_002"] and not drawn
    frame = select_frames(frames, "1")[0]
    assert (frame.load_left()[0, 0], frame.load_right()[0, 0], frame.load_occ()[0, 0]) == (1, 2, 6.0)
    assert np.isnan(frame.load_noc()[:, :5]).all() and (frame.load_noc()[:, 5:] == 6.0).all()
    assert drawn == [1]
    datasets._scene.cache_clear()


def test_scenes():
    pytest.importorskip("stereokit_evaluation.synthetic.scenes", exc_type=ImportError)
    frames = datasets.load_frames("scenes", count=2)
    assert len(frames) == 2 and [f.name for f in select_frames(frames, "1")] == [frames[1].name]
    frame = frames[1]
    left, right, noc, occ = (
        frame.load_left(gray=True),
        frame.load_right(gray=True),
        frame.load_noc(),
        frame.load_occ(),
    )
    assert left.ndim == 2 and left.shape == right.shape == noc.shape == occ.shape
    assert noc.dtype == occ.dtype == np.float32
    assert np.isfinite(noc).sum() < np.isfinite(occ).sum()
    both = np.isfinite(noc)
    np.testing.assert_array_equal(noc[both], occ[both])
    np.testing.assert_array_equal(left, datasets.load_frames("scenes", count=2)[1].load_left(gray=True))
    assert frame.max_disparity is None or np.nanmax(occ) < frame.max_disparity
    with pytest.raises(OptionError, match="count must be at least 1, got 0"):
        datasets.scenes(0)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "pairs", "noc", "occ"),
    [
        ("kitti2015", "training/image_2/*_10.png", "training/disp_noc_0/*.png", "training/disp_occ_0/*.png"),
        ("kitti2012", "training/image_0/*_10.png", "training/disp_noc/*.png", "training/disp_occ/*.png"),
        ("middlebury", "20??/*/", None, "20??/*/"),
    ],
)
def test_real_layouts(name, pairs, noc, occ):
    root = DATA / name
    if not root.is_dir():
        pytest.skip(f"no {name} in {DATA}; set STEREOKIT_DATA")
    frames = datasets.load_frames(name, root)
    assert len(frames) == len(list(root.glob(pairs))) > 0
    if noc is not None:
        assert sum(frame.noc is not None for frame in frames) == len(list(root.glob(noc)))
    assert sum(frame.occ is not None for frame in frames) == len(list(root.glob(occ)))
    for frame in frames[:10]:
        left, right = frame.load_left(gray=True), frame.load_right(gray=True)
        assert left.ndim == 2 and left.shape == right.shape
        for truth in (frame.load_noc(), frame.load_occ()):
            if truth is None:
                continue
            assert truth.shape == left.shape and truth.dtype == np.float32
            known = truth[np.isfinite(truth)]
            assert known.size > 0.05 * truth.size and known.min() > 0
            assert name.startswith("kitti") or known.max() < frame.max_disparity
