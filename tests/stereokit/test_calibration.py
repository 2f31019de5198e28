"""Depth and points against hand-computed numbers and OpenCV; files of each known form."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereokit.calibration import Calibration, read_calibration
from stereokit.errors import FileError, InputError, OptionError, StereokitWarning

DATA = Path(os.environ.get("STEREOKIT_DATA", Path(__file__).parents[3] / "shared" / "data"))
NAN = np.nan
SIMPLE = Calibration(fx=100, fy=50, cx0=2, cy=1, baseline_m=0.5)

# Middlebury 2014 Motorcycle, quarter size: the figures of its calib.txt.
MIDDLEBURY = """cam0=[999.421 0 294.182; 0 999.421 252.932; 0 0 1]
cam1=[999.421 0 326.96; 0 999.421 252.932; 0 0 1]
doffs=32.778
baseline=193.001
width=741
height=497
ndisp=70
"""
# KITTI raw, drive of 2011-09-26: the figures of its calib_cam_to_cam.txt.
KITTI = """calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_rect_02: 1.242000e+03 3.750000e+02
P_rect_00: 7.215377e+02 0 6.095593e+02 0 0 7.215377e+02 1.728540e+02 0 0 0 1 0
P_rect_01: 7.215377e+02 0 6.095593e+02 -3.875744e+02 0 7.215377e+02 1.728540e+02 0 0 0 1 0
P_rect_02: 721.5377 0 609.5593 4.485728e+01 0 721.5377 1.728540e+02 2.163791e-01 0 0 1 2.745884e-03
P_rect_03: 721.5377 0 609.5593 -3.395242e+02 0 721.5377 1.728540e+02 2.199936e+00 0 0 1 2.729905e-03
"""


def test_depth_by_hand():
    disparity = np.array([[50, 5, 0], [-1, NAN, np.inf]], np.float32)
    depth = SIMPLE.disparity_to_depth(disparity)
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth, [[1, 10, NAN], [NAN, NAN, NAN]])  # 100 * 0.5 / d


def test_depth_with_an_offset_between_the_principal_points():
    shifted = Calibration(fx=100, fy=100, cx0=2, cy=1, baseline_m=0.5, cx1=7)
    assert shifted.doffs == 5
    depth = shifted.disparity_to_depth(np.array([[0.0, 5, -4, -5, -6]]))
    np.testing.assert_array_equal(depth, [[10, 5, 50, NAN, NAN]])


def test_points_by_hand():
    points = SIMPLE.points(np.full((3, 4), 50, np.float32))
    assert points.shape == (3, 4, 3)
    assert points.dtype == np.float32
    np.testing.assert_allclose(points[1, 2], [0, 0, 1])
    np.testing.assert_allclose(points[0, 3], [1 / 100, -1 / 50, 1], rtol=1e-6)
    assert np.isnan(SIMPLE.points(np.zeros((1, 1), np.float32))).all()


@pytest.mark.parametrize("cx1", [None, 40.0])
def test_q_is_what_opencv_expects(cx1):
    calibration = Calibration(fx=700, fy=690, cx0=31.5, cy=12.25, baseline_m=0.54, cx1=cx1)
    disparity = np.random.default_rng(1).uniform(1, 90, (17, 23)).astype(np.float32)
    expected = cv2.reprojectImageTo3D(disparity, calibration.Q)
    np.testing.assert_allclose(calibration.points(disparity), expected, rtol=2e-5, atol=1e-6)
    assert calibration.Q.dtype == np.float64


def test_tiny_disparity_is_no_depth():
    assert np.isnan(SIMPLE.disparity_to_depth(np.array([[1e-40]], np.float32))).all()


def test_cx1_defaults_to_cx0():
    assert SIMPLE.cx1 == 2
    assert SIMPLE.doffs == 0


def test_half_size_gives_the_same_points():
    calibration = Calibration(fx=700, fy=690, cx0=31.5, cy=12.5, baseline_m=0.54, cx1=36.5, width=64, height=32)
    half = calibration.scaled(0.5)
    assert (half.width, half.height, half.fx, half.baseline_m, half.cx0) == (32, 16, 350, 0.54, 15.5)
    assert half.doffs == pytest.approx(2.5)
    full = calibration.points(np.full((32, 64), 20, np.float32))
    blocks = full.reshape(16, 2, 32, 2, 3).mean(axis=(1, 3))  # the centre of each 2x2 block
    np.testing.assert_allclose(half.points(np.full((16, 32), 10, np.float32)), blocks, rtol=1e-4, atol=1e-5)
    with pytest.raises(OptionError, match="factor"):
        calibration.scaled(0)


@pytest.mark.parametrize(
    ("name", "value"),
    [("fx", 0), ("fy", -1), ("baseline_m", 0), ("cx0", NAN), ("cx1", np.inf), ("width", 0), ("height", 2.5)],
)
def test_bad_numbers_are_named(name, value):
    with pytest.raises(OptionError, match=name):
        Calibration(**{"fx": 1, "fy": 1, "cx0": 0, "cy": 0, "baseline_m": 1, name: value})


def test_other_maps_are_refused():
    sized = Calibration(fx=1, fy=1, cx0=0, cy=0, baseline_m=1, width=4, height=3)
    assert sized.points(np.ones((3, 4))).shape == (3, 4, 3)
    with pytest.raises(InputError, match="4x3 pixels, got a map of 2x3"):
        sized.disparity_to_depth(np.ones((3, 2)))
    for bad in (np.ones(3), np.ones((2, 2), int)):
        with pytest.raises(InputError, match="disparity must be"):
            SIMPLE.points(bad)


def test_middlebury(tmp_path):
    path = tmp_path / "calib.txt"
    path.write_text(MIDDLEBURY)
    calibration = read_calibration(path)
    assert calibration.fx == calibration.fy == 999.421
    assert (calibration.cx0, calibration.cy, calibration.width, calibration.height) == (
        294.182,
        252.932,
        741,
        497,
    )
    assert calibration.baseline_m == pytest.approx(0.193001)
    assert calibration.doffs == pytest.approx(32.778)
    path.write_text(MIDDLEBURY.replace("doffs=32.778\n", ""))
    assert read_calibration(path).doffs == pytest.approx(326.96 - 294.182)


def test_kitti(tmp_path):
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text(KITTI)
    color = read_calibration(path)
    assert (color.fx, color.cx0, color.cy, color.doffs) == (721.5377, 609.5593, 172.854, 0)
    assert (color.width, color.height) == (1242, 375)
    assert color.baseline_m == pytest.approx((44.85728 + 339.5242) / 721.5377)  # 0.5327 m
    grey = read_calibration(path, cameras=(0, 1))
    assert grey.baseline_m == pytest.approx(387.5744 / 721.5377)  # 0.5372 m
    assert grey.width is None
    path.write_text("".join(line.replace("P_rect_0", "P") + "\n" for line in KITTI.splitlines() if line[0] == "P"))
    assert read_calibration(path).baseline_m == color.baseline_m
    with pytest.raises(FileError, match="to the right"):
        read_calibration(path, cameras=(1, 0))


def test_json(tmp_path):
    path = tmp_path / "calibration.json"
    fields = {"fx": 100, "fy": 50, "cx0": 2, "cy": 1.0, "baseline_m": 0.5}
    path.write_text(json.dumps(fields))
    assert read_calibration(path) == SIMPLE
    path.write_text(json.dumps({**fields, "cx1": 7, "width": 4}))
    assert read_calibration(path).doffs == 5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MIDDLEBURY.replace("baseline", "basis"), "no field 'baseline'"),
        (MIDDLEBURY.replace("cam0", "camera"), "no field 'cam0'"),
        ("cam0=[1 0 1; 0 1 1; 0 0 1]\nbaseline=3\n", "no field 'doffs'"),
        (MIDDLEBURY.replace("999.421 0 294.182", "999.421 0"), "cam0 must hold 9 numbers, got 8"),
        (MIDDLEBURY.replace("193.001", "wide"), "baseline must hold 1 numbers, got 'wide'"),
        (MIDDLEBURY.replace("741", "inf"), "width must hold finite numbers"),
        (MIDDLEBURY.replace("193.001", "-1"), "baseline must be positive, got -1"),
        (KITTI.replace("P_rect_03", "P_rect_04"), "no field 'P_rect_03'"),
        ("P0: 1 2 3\n", "no field 'P2'"),
        ("P2: 1 2 3\nP3: 1 2 3\n", "P2 must hold 12 numbers, got 3"),
        ('{"fx": 1, "fy": 1, "cx0": 1, "cy": 1}', "no field 'baseline_m'"),
        ('{"fx": 1, "focal": 1}', "unknown field 'focal'"),
        ('{"fx": "1"}', "fx must be a number"),
        ('{"fx": 1,', "not valid JSON"),
        ("hello\n", "no calibration known here"),
        ("", "no calibration known here"),
    ],
)
def test_errors_name_the_file_and_the_field(tmp_path, text, message):
    path = tmp_path / "calib.txt"
    path.write_text(text)
    with pytest.raises(FileError, match=message) as caught:
        read_calibration(path)
    assert "calib.txt" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(FileError, match="no such file"):
        read_calibration(tmp_path / "missing.txt")
    with pytest.raises(FileError, match="no calibration in the folder"):
        read_calibration(tmp_path)
    (tmp_path / "a.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FileError, match="not a text file"):
        read_calibration(tmp_path / "a.txt")


@pytest.mark.data
def test_real_calibration():
    path = DATA / "middlebury/2014/Motorcycle/calib.txt"
    if not path.is_file():
        pytest.skip(f"no real pairs in {DATA}; set STEREOKIT_DATA")
    calibration = read_calibration(path)
    assert calibration.doffs == pytest.approx(32.778)
    near, far = (
        calibration.disparity_to_depth(np.full((497, 741), 65.0))[0, 0],
        193.001 * 999.421 / (7 + 32.778) / 1e3,
    )
    assert near == pytest.approx(1.9727, abs=1e-3)
    assert far == pytest.approx(4.849, abs=1e-3)


LEFT, RIGHT = "cam0=[700 0 200; 0 700 80; 0 0 1]\n", "cam1=[700 0 240; 0 700 80; 0 0 1]\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LEFT + RIGHT + "doffs=-40\nbaseline=120\n", "doffs is -40, but cam0 and cam1 say 40"),
        (LEFT + RIGHT + "doffs=40.6\nbaseline=120\n", "doffs is 40.6"),
        (LEFT + RIGHT.replace("700", "701") + "baseline=120\n", "share fx, .* got 700 and 701"),
        (LEFT + RIGHT.replace("0 700 80", "0 690 80") + "baseline=120\n", "share fy, .* got 700 and 690"),
        (LEFT + RIGHT.replace("80", "80.7") + "baseline=120\n", "cam0 and cam1 must share cy, .* 80 and 80.7"),
        (LEFT.replace("700 0 200", "700 12 200") + RIGHT + "baseline=120\n", "cam0 .* skew of 12"),
        (LEFT + RIGHT.replace("700 0 240", "700 12 240") + "baseline=120\n", "cam1 .* skew of 12"),
        (LEFT.replace("0 0 1", "0 0 0") + RIGHT + "baseline=120\n", "cam0 must be a camera matrix"),
        (LEFT.replace("[700", "[0") + "doffs=0\nbaseline=120\n", "cam0 must begin with a positive focal length"),
        ("P2: 700 0 200 0 0 700 80 0 0 0 1 0\nP3: 640 0 200 -77 0 700 80 0 0 0 1 0\n", "P2 and P3 must share fx"),
        ("P2: 700 0 200 0 0 700 80 0 0 0 1 0\nP3: 700 0 200 -77 0 640 80 0 0 0 1 0\n", "P2 and P3 must share fy"),
        ("P2: 700 0 200 0 0 700 80 0 0 0 1 0\nP3: 700 0 200 -77 0 700 95 0 0 0 1 0\n", "P2 and P3 must share cy"),
        ("P2: 700 0 200 0 0 700 80 0 0 0 1 0\nP3: 700 9 200 -77 0 700 80 0 0 0 1 0\n", "P3 .* skew of 9"),
    ],
)
def test_what_contradicts_itself_is_refused(tmp_path, text, message):
    path = tmp_path / "calib.txt"
    path.write_text(text)
    with pytest.raises(FileError, match=message) as caught:
        read_calibration(path)
    assert "calib.txt" in str(caught.value) and "\n" not in str(caught.value)


def test_what_differs_by_rounding_is_taken(tmp_path):
    path = tmp_path / "calib.txt"
    path.write_text(LEFT + RIGHT.replace("700 0", "700.3 0.2").replace("80", "80.4") + "doffs=40.3\nbaseline=120\n")
    calibration = read_calibration(path)
    assert (calibration.fx, calibration.cy, calibration.doffs) == (700, 80, pytest.approx(40.3))


@pytest.mark.parametrize("change", [lambda b: b"\xef\xbb\xbf" + b, lambda b: b.replace(b"\n", b"\r\n")])
def test_files_of_windows_are_read_like_others(tmp_path, change):
    path = tmp_path / "calib.txt"
    for text in (MIDDLEBURY, KITTI, '{"fx": 100, "fy": 50, "cx0": 2,\n "cy": 1, "baseline_m": 0.5, "width": 640.0}\n'):
        path.write_text(text)
        plain = read_calibration(path)
        path.write_bytes(change(text.encode()))
        assert read_calibration(path) == plain
    assert plain.width == 640 and isinstance(plain.width, int)


@pytest.mark.parametrize("text", ["\n" * 300_000 + "x", " \n" * 300_000 + "x", "x\n" + "\n" * 300_000 + ":"])
def test_a_file_of_blank_lines_is_refused_and_does_not_hang(tmp_path, text):
    path = tmp_path / "calib.txt"  # the time of the patterns grew with the square of the blank lines: hours for these
    path.write_text(text)
    with pytest.raises(FileError, match="no calibration known here"):
        read_calibration(path)


def test_sizes_may_be_whole_numbers_of_any_type():
    sizes = Calibration(1, 1, 0, 0, 1, width=np.int64(4), height=3.0)
    assert (sizes.width, sizes.height) == (4, 3) and isinstance(sizes.width, int)
    for bad in (640.5, True, 0, float("nan"), 10**400):
        with pytest.raises(OptionError, match="width must be a positive whole number"):
            Calibration(1, 1, 0, 0, 1, width=bad)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("%YAML:1.0\n---\nP2: !!opencv-matrix\n   rows: 3\n", "no calibration known here; known are OpenCV's YAML"),
        ('<?xml version="1.0"?>\n<opencv_storage>\n<M1></M1>\n', "not valid XML"),
        ('<?xml version="1.0"?>\n<opencv_storage>\n<M1>3</M1></opencv_storage>\n', "no calibration known here"),
        ('{"M1": {"type_id": "opencv-matrix", "rows": 3}}', "no calibration known here; known are .*Middlebury"),
        (
            "image_width: 400\ncamera_name: right\nprojection_matrix:\n  rows: 3\n",
            "ROS camera_info file without the rect",
        ),
        ("cam0:\n  camera_model: pinhole\n  distortion_coeffs: [0, 0]\n  intrinsics: [1, 2]\n", "no camera 'cam1'"),
        ("[LEFT_CAM_HD]\nfx=700\n[STEREO]\nBaseline=120\n", "LEFT_CAM_HD.* has no fy"),
        ('{"extrinsic": {"baseline": 0.2}, "intrinsic": {"fx": 2262}}', "no field 'fy', which a Cityscapes"),
        ("700 0 200 0 700 80 0 0 1\n", "nine numbers of a camera matrix, but no baseline"),
        ("700 0 200 0 700 80 0 0 1 2 3\n", "nine numbers of a camera matrix and the baseline, got 11"),
        ("model: pinhole\nleftToRight:\n  x: 3\n", "looks like a BoofCV calibration, which is not read; known are"),
    ],
)
def test_parts_of_files_of_others_say_what_is_missing(tmp_path, text, words):
    path = tmp_path / "calib.txt"
    path.write_text(text)
    with pytest.raises(FileError, match=words) as caught:
        read_calibration(path)
    assert "calib.txt" in str(caught.value) and "\n" not in str(caught.value)


P1 = np.array([[700.0, 0, 200, 0], [0, 700, 80, 0], [0, 0, 1, 0]])
P2 = P1 + np.array([[0, 0, 12, -84.0], [0] * 4, [0] * 4])
Q = Calibration(fx=700, fy=700, cx0=200, cy=80, baseline_m=0.12, cx1=212).Q


def opencv(suffix, **entries):
    file = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, value in entries.items():
        file.write(name, value)
    return file.releaseAndGetString()


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
@pytest.mark.parametrize(
    "entries", [{"P1": P1, "P2": P2}, {"Q": Q}, {"P_left": P1, "P_right": P2, "Q": Q}, {"PL": P1, "PR": P2}]
)
def test_a_pair_that_opencv_rectified(tmp_path, suffix, entries):
    path = tmp_path / f"stereo{suffix}"
    path.write_text(opencv(suffix, **entries))
    camera = read_calibration(path)
    assert (camera.fx, camera.fy, camera.cx0, camera.cy) == (700, 700, 200, 80)
    assert (camera.doffs, camera.baseline_m) == (pytest.approx(12), pytest.approx(0.12))
    path.write_text(opencv(suffix, imageWidth=400, imageHeight=160, **entries))
    assert read_calibration(path).width is None  # of the raw images, which these need not be


def test_a_pair_of_ros_files_or_the_right_one_with_its_left(tmp_path):
    paths = tmp_path / "left.yaml", tmp_path / "right.yaml"
    for path, p in zip(paths, (P1, P2), strict=True):
        data = ", ".join(map(str, p.ravel()))
        path.write_text(
            f"image_width: 400\nimage_height: 160\nprojection_matrix:\n  rows: 3\n  cols: 4\n  data: [{data}]\n"
        )
    for camera in (read_calibration(paths[0], right=paths[1]), read_calibration(tmp_path)):
        assert (camera.fx, camera.doffs, camera.baseline_m) == (700, 12, pytest.approx(0.12))
    with pytest.raises(FileError, match=r"both of left.yaml and right.yaml"):
        read_calibration(paths[0])
    with pytest.raises(FileError, match="exchanged"):
        read_calibration(paths[1], right=paths[0])


def test_raw_cameras_are_no_rectified_pair(tmp_path):
    k = np.array([[700.0, 0, 200], [0, 700, 80], [0, 0, 1]])
    path = tmp_path / "stereo.yml"
    path.write_text(opencv(".yml", K1=k, K2=k, R=np.eye(3), T=np.array([[-0.12], [0], [0]])))
    with pytest.raises(
        FileError, match=r"of raw cameras: its images must be rectified first, which .*read_rig and --rig do"
    ):
        read_calibration(path)


def test_millimetres_are_told(tmp_path):
    path = tmp_path / "K.txt"
    path.write_text("700 0 200 0 700 80 0 0 1\n60\n")
    with pytest.warns(StereokitWarning, match="baseline of 60, which is taken for millimetres .0.06 m"):
        assert read_calibration(path).baseline_m == pytest.approx(0.06)
    assert read_calibration(path, unit="mm").baseline_m == pytest.approx(0.06)
    assert read_calibration(path, unit="cm").baseline_m == pytest.approx(0.6)
    path.write_text(MIDDLEBURY)  # whose unit is known
    assert read_calibration(path).baseline_m == pytest.approx(0.193001)


def test_odd_figures_are_warned_of(tmp_path):
    path = tmp_path / "calibration.json"
    fields = {"fx": 700, "fy": 700, "cx0": 200, "cy": 80, "baseline_m": 0.12}
    for change, words in (
        ({"baseline_m": 120}, "a baseline of 120 m"),
        ({"baseline_m": 0.0005}, "a baseline of 0.0005 m"),
        ({"width": 200}, "cx0 is 200 of 200 pixels"),
        ({"cy": -3, "height": 160}, "cy is -3 of 160 pixels"),
    ):
        path.write_text(json.dumps({**fields, **change}))
        with pytest.warns(StereokitWarning, match=words):
            read_calibration(path)
    path.write_text(json.dumps(fields))
    with pytest.warns(StereokitWarning, match="principal point outside"):
        read_calibration(path, size=(150, 160))
    assert read_calibration(path, size=(400, 160)).fx == 700  # and no warning, which would be an error here
    path.write_text(json.dumps({**fields, "width": 400}))
    with pytest.raises(InputError, match="400x"):
        read_calibration(path, size=(401, 160))


@pytest.mark.data
def test_real_calibrations_do_not_contradict_themselves():
    paths = [*DATA.glob("middlebury/2014/*/calib.txt"), *DATA.glob("eth3d/two_view_training/*/calib.txt")]
    paths += [*DATA.glob("kitti201*/**/calib*/*.txt")]
    if not paths:
        pytest.skip(f"no real pairs in {DATA}; set STEREOKIT_DATA")
    for path in paths:
        assert read_calibration(path).baseline_m > 0.01
