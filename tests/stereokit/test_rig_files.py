"""Calibration files of all formats: one rig with known numbers, written as each program writes it, is read back."""

from __future__ import annotations

import json
import zipfile

import cv2
import numpy as np
import pytest

from stereokit.errors import FileError, InputError, OptionError, StereokitWarning
from stereokit.rig import Camera, StereoRig, read_rig

K1 = np.array([[700.5, 0, 321.25], [0, 701.5, 239.75], [0, 0, 1]])
K2 = np.array([[698.5, 0, 318.0], [0, 699.25, 242.5], [0, 0, 1]])
D1 = np.array([-0.28, 0.1, 1e-3, -8e-4, 0.02])
D2 = np.array([-0.26, 0.09, -6e-4, 1.1e-3, -1.5e-2])
FISH1, FISH2 = np.array([0.05, -0.01, 4e-3, -1e-3]), np.array([0.04, -8e-3, 3e-3, -6e-4])
R = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
T = np.array([-0.12, 1e-3, -2e-3])
WIDTH, HEIGHT = 640, 480
RIG = StereoRig(Camera(K1, D1, "pinhole", WIDTH, HEIGHT), Camera(K2, D2, "pinhole", WIDTH, HEIGHT), R, T)


def rectified_cameras(unit=1.0):
    r1, r2, p1, p2, q = cv2.stereoRectify(K1, D1, K2, D2, (WIDTH, HEIGHT), R, (T * unit).reshape(3, 1), alpha=0)[:5]
    return {"R1": r1, "R2": r2, "P1": p1, "P2": p2, "Q": q}


def opencv(suffix, entries):
    file = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, value in entries.items():
        file.write(name, np.atleast_2d(np.asarray(value, float)) if isinstance(value, np.ndarray) else value)
    return file.releaseAndGetString()


def basic(k="K{}", d="D{}", sides=(1, 2), r="R", t="T", unit=1.0):
    names = [form.format(side) for side in sides for form in (k, d)]
    return dict(zip(names, (K1, D1, K2, D2), strict=True)) | {r: R, t: (T * unit).reshape(3, 1)}


def check(rig, d=(D1, D2), model="pinhole", size=(WIDTH, HEIGHT), atol=1e-9):
    assert isinstance(rig, StereoRig)
    for camera, k, coefficients in zip((rig.left, rig.right), (K1, K2), d, strict=True):
        np.testing.assert_allclose(camera.matrix, k, atol=atol)
        np.testing.assert_allclose(camera.distortion, coefficients, atol=atol)
        assert camera.model == model and camera.size == size
    np.testing.assert_allclose(rig.rotation, R, atol=max(atol, 1e-12))
    np.testing.assert_allclose(rig.translation_m, T, atol=max(atol, 1e-12))


SPELLINGS = {
    "K1 D1": basic(),
    "M1 D1": basic("M{}"),
    "cameraMatrix1 distCoeffs1": basic("cameraMatrix{}", "distCoeffs{}"),
    "camera_matrix_left": basic("camera_matrix_{}", "dist_coeffs_{}", ("left", "right")),
    "left_camera_matrix": basic("{}_camera_matrix", "{}_distortion_coefficients", ("left", "right"), "rot", "tvec"),
    "leftCameraMatrix": basic("{}CameraMatrix", "{}DistCoeffs", ("left", "right"), "rotationMatrix", "translation"),
    "K_l": basic("K_{}", "D_{}", ("l", "r"), "Rot", "Trans"),
    "mtxL": basic("mtx{}", "dist{}", ("L", "R"), "R", "T"),
    "K0": basic("K{}", "D{}", (0, 1)),
    "Intrinsic_1": basic("Intrinsic_{}", "Distortion_{}", (1, 2), "Rotation_matrix", "Translation_vector"),
}  # fmt: skip


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
@pytest.mark.parametrize("name", SPELLINGS)
def test_opencv_files_in_the_usual_spellings(tmp_path, name, suffix):
    path = tmp_path / f"stereo{suffix}"
    path.write_text(opencv(suffix, {"image_width": WIDTH, "image_height": HEIGHT, **SPELLINGS[name]}))
    check(read_rig(path))


@pytest.mark.parametrize("name", SPELLINGS)
def test_arrays_as_numpy_and_json_have_them(tmp_path, name):
    np.savez(tmp_path / "stereo.npz", imageSize=(640, 480), rms=0.3, note="mine", **SPELLINGS[name])
    check(read_rig(tmp_path / "stereo.npz"))
    plain = {key: value.tolist() for key, value in SPELLINGS[name].items()}
    for content in ({"image_size": [640, 480], **plain}, {"width": 640, "height": 480, **plain}):
        (tmp_path / "stereo.json").write_text(json.dumps(content))
        check(read_rig(tmp_path / "stereo.json"))


def test_a_camera_for_each_side(tmp_path):
    sides = [{"K": k.tolist(), "dist_coeffs": d.tolist(), "width": 640, "height": 480} for k, d in ((K1, D1), (K2, D2))]
    pose = {"R": R.tolist(), "T": T.tolist()}
    for content in (
        {"left": sides[0], "right": sides[1], "extrinsics": pose}, {"cam0": sides[0], "cam1": sides[1], **pose},
        {"left_camera": sides[0], "right_camera": sides[1], "stereo": pose},
        {"camera_1": sides[0], "camera_2": sides[1], **pose},
    ):  # fmt: skip
        (tmp_path / "stereo.json").write_text(json.dumps(content))
        check(read_rig(tmp_path / "stereo.json"))


@pytest.mark.parametrize(
    "entries",
    [
        {"imageSize": np.array([640.0, 480.0])}, {"image_size": np.array([640.0, 480.0])},
        {"width": 640, "height": 480}, {"imageWidth": 640, "imageHeight": 480}, {"img_shape": np.array([480.0, 640.0])},
        {"calibration_time": "Mon 30 Nov", "nframes": 13, "resolution": np.array([640.0, 480.0])},
    ],
)  # fmt: skip
def test_opencv_files_with_the_usual_sizes(tmp_path, entries):
    for suffix in (".yml", ".xml"):
        path = tmp_path / f"stereo{suffix}"
        path.write_text(opencv(suffix, {**entries, **basic()}))
        check(read_rig(path))


def test_a_size_as_opencv_writes_it(tmp_path):
    for suffix, size in ((".yml", "imageSize: [ 640, 480 ]\n"), (".xml", "<imageSize>\n  640 480</imageSize>\n")):
        text = opencv(suffix, basic())
        end = "</opencv_storage>"
        path = tmp_path / f"stereo{suffix}"
        path.write_text(text.replace(end, size + end) if suffix == ".xml" else text + size)
        check(read_rig(path))


def test_without_a_size_the_images_tell_it(tmp_path):
    path = tmp_path / "stereo.yml"
    path.write_text(opencv(".yml", basic()))
    check(read_rig(path), size=None)
    check(read_rig(path, size=(WIDTH, HEIGHT)))
    rig = read_rig(path)
    with pytest.raises(OptionError, match="does not know the size"):
        rig.rectified()
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    rig.rectify(image, image)
    assert rig.size == (WIDTH, HEIGHT)
    with pytest.raises(InputError, match=r"principal point at 321.25, 239.75, outside of the images of 300x300"):
        read_rig(path, size=(300, 300))


@pytest.mark.parametrize("header", ["%YAML:1.0\n", "%YAML:1.0\n---\n", "%YAML 1.2\n---\n", ""])
def test_yaml_by_any_version_of_opencv(tmp_path, header):
    body = opencv(".yml", {"image_width": WIDTH, "image_height": HEIGHT, **basic()}).split("---\n")[1]
    path = tmp_path / "stereo.yaml"
    path.write_text(header + body)
    check(read_rig(path))


def test_numbers_in_every_form(tmp_path):
    text = """---
image_width: 640
image_height: 480
K1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 7.005e2, 0., 3.2125E+02, 0, 7.015e+2, 239.75,
       0., 0., 1. ]
D1: [ -0.28, 1e-1, 1e-3, -8e-4, 2e-2 ]
K2: [[698.5, 0, 318], [0, 699.25, 242.5], [0, 0, 1]]
D2: [ -.26, 9.0E-2, -6E-4, 0.0011, -1.5e-2 ]
R: [{}]
T: [ -1.2e-1, 1.e-3, -2e-3 ]
""".format(", ".join(map(repr, map(float, R.ravel()))))
    for change in (
        lambda b: b"%YAML:1.0\n" + b,
        lambda b: b"\xef\xbb\xbf" + b,
        lambda b: b.replace(b"\n", b"\r\n"),
        lambda b: b + b"\t\n",
    ):
        path = tmp_path / "stereo.yml"
        path.write_bytes(change(text.encode()))
        check(read_rig(path))


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_pinhole_cameras_with_every_number_of_coefficients(tmp_path, count):
    d = np.linspace(-0.01, 0.02, count)
    for suffix in (".yml", ".xml", ".json"):
        path = tmp_path / f"stereo{suffix}"
        path.write_text(opencv(suffix, {"imageSize": np.array([640.0, 480.0]), **basic(), "D1": d, "D2": -d}))
        check(read_rig(path), (d, -d))


def test_a_fisheye_is_told_by_a_word_or_by_the_reader(tmp_path):
    entries = {"width": WIDTH, "height": HEIGHT, **basic(), "D1": FISH1, "D2": FISH2}
    path = tmp_path / "stereo.yml"
    for more in (
        {"camera_model": "fisheye"},
        {"distortion_model": "equidistant"},
        {"fisheye": 1},
        {"model": "Kannala_Brandt"},
    ):
        path.write_text(opencv(".yml", {**more, **entries}))
        check(read_rig(path), (FISH1, FISH2), "fisheye")
    path.write_text(opencv(".yml", entries))
    check(read_rig(path), (FISH1, FISH2))
    check(read_rig(path, model="fisheye"), (FISH1, FISH2), "fisheye")
    path.write_text(opencv(".yml", {**entries, "model": "double_sphere"}))
    with pytest.raises(FileError, match=r"camera model must be pinhole .* or equidistant fisheye, got 'double_sphere'"):
        read_rig(path)


def test_two_files_of_opencv(tmp_path):
    intrinsics, extrinsics = tmp_path / "intrinsics.yml", tmp_path / "extrinsics.yml"
    m = basic("M{}")
    intrinsics.write_text(opencv(".yml", {name: m[name] for name in ("M1", "D1", "M2", "D2")}))
    extrinsics.write_text(opencv(".yml", {"R": R, "T": T.reshape(3, 1), **rectified_cameras()}))
    check(read_rig(intrinsics, extrinsics), size=None)
    check(read_rig(extrinsics, intrinsics, size=(WIDTH, HEIGHT)))
    check(read_rig(tmp_path), size=None)
    with pytest.raises(FileError, match=r"does not tell how the cameras stand.*R and T.*extrinsics.yml"):
        read_rig(intrinsics)
    for path in ("left.yml", "right.yml"):
        k, d = (K1, D1) if path == "left.yml" else (K2, D2)
        (tmp_path / path).write_text(opencv(".yml", {"camera_matrix": k, "distortion_coefficients": d}))
    with pytest.raises(FileError, match="does not tell how the cameras stand"):
        read_rig(tmp_path / "left.yml", tmp_path / "right.yml")


def flat(values):
    return "[" + ", ".join(repr(float(v)) for v in np.ravel(values)) + "]"


def ros(side, unit=1.0, model="plumb_bob", d=None):
    k, coefficients, n = (K1, D1, 1) if side == "left" else (K2, D2, 2)
    rectified = rectified_cameras(unit)
    coefficients = coefficients if d is None else d
    return f"""image_width: {WIDTH}
image_height: {HEIGHT}
camera_name: narrow_stereo/{side}
camera_matrix:
  rows: 3
  cols: 3
  data: {flat(k)}
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {len(coefficients)}
  data: {flat(coefficients)}
rectification_matrix:
  rows: 3
  cols: 3
  data: {flat(rectified[f"R{n}"])}
projection_matrix:
  rows: 3
  cols: 4
  data: {flat(rectified[f"P{n}"])}
"""


def test_ros_camera_info(tmp_path):
    left, right = tmp_path / "left.yaml", tmp_path / "right.yaml"
    for path in (left, right):
        path.write_text(ros(path.stem))
    check(read_rig(left, right))
    check(read_rig(tmp_path))
    with pytest.raises(FileError, match=r"left and right are exchanged|to the left of the left one"):
        read_rig(right, left)
    with pytest.raises(FileError, match=r"does not tell the cameras .K1 and D1.*and how they stand.*right.yaml"):
        read_rig(left)
    for path, d in ((left, np.linspace(0, 0.07, 8)), (right, np.linspace(0, -0.07, 8))):
        path.write_text(ros(path.stem, model="rational_polynomial", d=d))
    check(read_rig(left, right), (np.linspace(0, 0.07, 8), np.linspace(0, -0.07, 8)))
    for path, d in ((left, FISH1), (right, FISH2)):
        path.write_text(ros(path.stem, model="equidistant", d=d))
    check(read_rig(left, right), (FISH1, FISH2), "fisheye")


def test_ros_messages_as_they_are_printed(tmp_path):
    rectified = rectified_cameras()
    for upper in (False, True):
        for n, (side, k, d) in enumerate((("left", K1, D1), ("right", K2, D2)), start=1):
            names = [name.upper() if upper else name for name in "kdrp"]
            values = dict(zip(names, (k, d, rectified[f"R{n}"], rectified[f"P{n}"]), strict=True))
            lines = ["header:", "  stamp:", "    sec: 1", "  frame_id: camera", "height: 480", "width: 640",
                     "distortion_model: plumb_bob"]  # fmt: skip
            for name, value in values.items():
                lines += [f"{name}:", *(f"- {float(v)!r}" for v in np.ravel(value))]
            (tmp_path / f"{side}.yaml").write_text("\n".join([*lines, "binning_x: 0", "---", ""]))
        check(read_rig(tmp_path / "left.yaml", tmp_path / "right.yaml"))


def rows(matrix):
    return "".join(f"  - {flat(row)}\n" for row in matrix)


def pose(r=R, t=T):
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = r, t
    return whole


def kalibr(model="radtan", d=(D1[:4], D2[:4]), more="", transform=None):
    text = ""
    for n, (k, coefficients) in enumerate(zip((K1, K2), d, strict=True)):
        text += f"cam{n}:\n"
        if n:
            text += transform or f"  T_cn_cnm1:\n{rows(pose())}"
        text += f"""  cam_overlaps: [{1 - n}]
  camera_model: pinhole
  distortion_coeffs: {flat(coefficients)}
  distortion_model: {model}
  intrinsics: {flat((k[0, 0], k[1, 1], k[0, 2], k[1, 2]))}
  resolution: [640, 480]
  rostopic: /cam{n}/image_raw
"""
    return text + more


def test_kalibr(tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(kalibr())
    check(read_rig(path), (D1[:4], D2[:4]))
    path.write_text(kalibr("equidistant", (FISH1, FISH2)))
    check(read_rig(path), (FISH1, FISH2), "fisheye")
    with pytest.raises(FileError, match="no camera 'cam2'; it has cam0, cam1"):
        read_rig(path, cameras=(0, 2))
    with pytest.raises(FileError, match=r"to the left of the left one .the sign of T.: left and right are exchanged"):
        read_rig(path, cameras=(1, 0))
    path.write_text(kalibr().replace("pinhole", "omni"))
    with pytest.raises(FileError, match=r"cam0: the camera model must be pinhole.*got 'omni'"):
        read_rig(path)
    path.write_text(kalibr(transform="  timeshift: 0\n"))
    with pytest.raises(FileError, match="cam1 has no T_cn_cnm1, which says how it stands to cam0"):
        read_rig(path)


def test_kalibr_with_a_third_camera_and_with_poses_to_an_imu(tmp_path):
    path = tmp_path / "camchain.yaml"
    step = pose(cv2.Rodrigues(np.array([0.0, 0.01, 0.0]))[0], (-0.2, 0, 0))
    third = kalibr().split("cam1:")[1].replace("cam1", "cam2")
    third = "cam2:" + third.replace(rows(pose()), rows(step))
    path.write_text(kalibr(more=third))
    check(read_rig(path), (D1[:4], D2[:4]))
    far = read_rig(path, cameras=(0, 2))
    np.testing.assert_allclose(far.translation_m, (step @ pose())[:3, 3], atol=1e-12)
    body = pose(cv2.Rodrigues(np.array([0.3, -1.2, 0.7]))[0], (0.05, -0.02, 0.4))
    text = kalibr(transform=f"  T_cam_imu:\n{rows(pose() @ body)}")
    path.write_text(text.replace("cam0:\n", f"cam0:\n  T_cam_imu:\n{rows(body)}"))
    check(read_rig(path), (D1[:4], D2[:4]))


def euroc(n, body):
    k, d = (K1, D1) if n == 0 else (K2, D2)
    return f"""# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam{n} (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: {flat(body)}

# Camera specific definitions.
rate_hz: 20
resolution: [640, 480]
camera_model: pinhole
intrinsics: {flat((k[0, 0], k[1, 1], k[0, 2], k[1, 2]))} #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: {flat(d[:4])}
"""


def test_euroc(tmp_path):
    body = pose(cv2.Rodrigues(np.array([0.3, -1.2, 0.7]))[0], (0.05, -0.02, 0.4))  # camera 0 in the body
    for n, place in enumerate((body, body @ np.linalg.inv(pose()))):
        (tmp_path / "mav0" / f"cam{n}").mkdir(parents=True)
        (tmp_path / "mav0" / f"cam{n}" / "sensor.yaml").write_text(euroc(n, place))
    check(read_rig(tmp_path), (D1[:4], D2[:4]))
    with pytest.raises(FileError, match="sensor file of one camera; give both"):
        read_rig(tmp_path / "mav0/cam0/sensor.yaml")


def zed(baseline=120.0):
    turn = cv2.Rodrigues(R)[0].ravel()
    text = ""
    for name, factor in (("2K", 2208 / 640), ("HD", 2.0), ("VGA", 1.0)):
        for side, k, d in (("LEFT", K1, D1), ("RIGHT", K2, D2)):
            numbers = dict(zip(("fx", "fy", "cx", "cy"), (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), strict=True))
            numbers = {key: value * factor for key, value in numbers.items()}
            numbers |= dict(zip(("k1", "k2", "p1", "p2", "k3"), d, strict=True))
            text += f"[{side}_CAM_{name}]\n" + "".join(f"{key}={float(v)!r}\n" for key, v in numbers.items()) + "\n"
    text += f"[STEREO]\nBaseline={baseline}\nTY=1.0\nTZ=-2.0\n"
    for name in ("2K", "HD", "VGA"):
        text += f"CV_{name}={turn[1]:.17g}\nRX_{name}={turn[0]:.17g}\nRZ_{name}={turn[2]:.17g}\n"
    return text


def test_zed(tmp_path):
    path = tmp_path / "SN1234.conf"
    path.write_text(zed())
    rig = read_rig(path, size=(672, 376))
    check(rig, size=(672, 376))
    assert read_rig(path, size=(1280, 720)).left.matrix[0, 0] == 2 * K1[0, 0]
    with pytest.raises(
        FileError, match="several resolutions, so the size of the images must be told: 2K 2208x1242, HD"
    ):
        read_rig(path)
    with pytest.raises(FileError, match="other resolutions: 2K 2208x1242"):
        read_rig(path, size=(640, 480))
    path.write_text(zed().replace("Baseline", "Base"))
    with pytest.raises(FileError, match=r"\[STEREO\] has no Baseline"):
        read_rig(path, size=(672, 376))


def test_kitti_with_its_raw_cameras(tmp_path):
    """Cameras 2 and 3 stand anywhere to camera 0: what counts is how 3 stands to 2."""
    second = pose(cv2.Rodrigues(np.array([0.004, -0.02, 0.01]))[0], (0.06, 0.001, 0.002))
    rectified = rectified_cameras()
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.95e-02"]
    for n, k, d, place in ((2, K1, D1, second), (3, K2, D2, pose() @ second)):
        for name, value in (("S", (640, 480)), ("K", k), ("D", d), ("R", place[:3, :3]), ("T", place[:3, 3])):
            lines.append(f"{name}_{n:02d}: " + " ".join(f"{v:.15e}" for v in np.ravel(value)))
        for name, value in (
            ("S_rect", (640, 480)),
            ("R_rect", rectified[f"R{n - 1}"]),
            ("P_rect", rectified[f"P{n - 1}"]),
        ):
            lines.append(f"{name}_{n:02d}: " + " ".join(f"{v:.15e}" for v in np.ravel(value)))
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text("\n".join(lines) + "\n")
    rig = read_rig(path)
    check(rig, atol=1e-12)
    assert rig.rectified().fx == pytest.approx(rectified["P1"][0, 0])
    text = path.read_text()
    path.write_text(
        text.replace("S_rect_02: 6.400000000000000e+02 4.800000000000000e+02", "S_rect_02: 6.2e+02 4.6e+02")
    )
    assert path.read_text() != text and read_rig(path).rectification().size == (620, 460)
    with pytest.raises(InputError, match="got 620x460, and those are rectified ones: nothing is left to rectify"):
        read_rig(path, size=(620, 460))


RECTIFIED = {
    "calib.txt": "cam0=[700 0 320; 0 700 240; 0 0 1]\ncam1=[700 0 330; 0 700 240; 0 0 1]\ndoffs=10\nbaseline=120\n"
    "width=640\nheight=480\n",
    "kitti.txt": "P2: 700 0 320 0 0 700 240 0 0 0 1 0\nP3: 700 0 330 -84 0 700 240 0 0 0 1 0\n",
    "camera.json": '{"fx": 700, "fy": 700, "cx0": 320, "cx1": 330, "cy": 240, "baseline_m": 0.12}',
    "K.txt": "700 0 320 0 700 240 0 0 1\n0.12\n",
    "K3.txt": "700.0 0 320\n0 700 240\n0 0 1\n1.2e-1",
    "frankfurt_camera.json": '{"extrinsic": {"baseline": 0.12, "pitch": 0.03, "x": 1.7}, '
    '"intrinsic": {"fx": 700, "fy": 700, "u0": 320, "v0": 240}}',
}


@pytest.mark.parametrize("name", RECTIFIED)
def test_a_rectified_pair_is_a_rig_with_nothing_left_to_do(tmp_path, name):
    path = tmp_path / name
    path.write_text(RECTIFIED[name])
    rig = read_rig(path, size=(WIDTH, HEIGHT))
    camera = rig.rectified()
    doffs = 0 if name[0] in "Kf" else 10
    assert (camera.fx, camera.fy, camera.cx0, camera.cy, camera.doffs) == (700, 700, 320, 240, doffs)
    assert camera.baseline_m == pytest.approx(0.12)
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    left, right = rig.rectify(image, image)
    np.testing.assert_array_equal(left, image)
    np.testing.assert_array_equal(right, image)


def equal(a, b, atol=0.0):
    assert (a.left.model, a.right.model, a.size) == (b.left.model, b.right.model, b.size)
    for x, y in ((a.left, b.left), (a.right, b.right)):
        np.testing.assert_allclose(x.matrix, y.matrix, rtol=0, atol=atol)
        np.testing.assert_allclose(x.distortion, y.distortion, rtol=0, atol=atol)
    np.testing.assert_allclose(a.rotation, b.rotation, rtol=0, atol=atol)
    np.testing.assert_allclose(a.translation_m, b.translation_m, rtol=0, atol=atol)


@pytest.mark.parametrize("suffix", [".yml", ".yaml", ".xml", ".json"])
@pytest.mark.parametrize("count", [4, 5, 8, 12, 14, "fisheye"])
def test_what_is_saved_is_read_back_to_the_last_digit(tmp_path, suffix, count):
    model, d = ("fisheye", FISH1) if count == "fisheye" else ("pinhole", np.linspace(-0.01, 0.02, count) / 3)
    rig = StereoRig(Camera(K1, d, model, WIDTH, HEIGHT), Camera(K2, d * 0.9, model, WIDTH, HEIGHT), R, T)
    path = tmp_path / f"rig{suffix}"
    rig.save(path)
    again = read_rig(path)
    equal(again, rig)
    assert again.rectified() == rig.rectified()
    again.save(tmp_path / f"again{suffix}")
    assert (tmp_path / f"again{suffix}").read_bytes() == path.read_bytes()
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(file.getNode("K2").mat(), K2)
    np.testing.assert_array_equal(file.getNode("T").mat().ravel(), T)
    np.testing.assert_allclose(file.getNode("Q").mat(), rig.rectified().Q)


def test_a_rig_without_a_size_is_saved_too(tmp_path):
    rig = StereoRig(Camera(K1, D1), Camera(K2, D2), R, T)
    rig.save(tmp_path / "rig.yml")
    equal(read_rig(tmp_path / "rig.yml"), rig)
    with pytest.raises(FileError, match=r"must end in one of .yml, .yaml, .xml, .json, got"):
        rig.save(tmp_path / "rig.txt")


@pytest.mark.parametrize(
    ("baseline", "found_m", "words"),
    [
        (0.12, 0.12, None),
        (
            60.0,
            0.060,
            "baseline of 60, which is taken for millimetres .0.06 m.; if it is in another unit, say so with unit=",
        ),
        (
            6.0,
            6.0,
            "baseline of 6, taken for metres; if the board's squares were in another unit, or in squares, say so",
        ),
        (0.0005, 0.0005, "baseline of 0.0005 m: is it in the unit"),
    ],
)
def test_lengths_that_are_not_metres_are_told(tmp_path, baseline, found_m, words):
    path = tmp_path / "stereo.yml"
    path.write_text(opencv(".yml", basic(unit=baseline / np.linalg.norm(T))))
    if words is None:
        assert read_rig(path).baseline_m == pytest.approx(found_m)
        return
    with pytest.warns(StereokitWarning, match=words):
        assert read_rig(path).baseline_m == pytest.approx(found_m)
    if baseline > 1:
        assert read_rig(path, unit="mm").baseline_m == pytest.approx(baseline / 1000)
        assert read_rig(path, unit="cm").baseline_m == pytest.approx(baseline / 100)
    with pytest.raises(OptionError, match="unit must be one of m, cm, mm, in, got 'ft'"):
        read_rig(path, unit="ft")


def test_a_pair_of_ros_that_was_calibrated_in_millimetres(tmp_path):
    for side in ("left", "right"):
        (tmp_path / f"{side}.yaml").write_text(ros(side, unit=1000.0))
    with pytest.warns(StereokitWarning, match="taken for millimetres"):
        check(read_rig(tmp_path))


def skewed(k):
    k = k.copy()
    k[0, 1] = 12
    return k


WRONG = {
    "omnidirectional": ({"xi1": np.array([[2.5]])}, "omnidirectional one .it has xi"),
    "skew": ({"K1": skewed(K1)}, r"k1 must be of a camera without skew, got a skew of 12"),
    "rotation": ({"R": R * 1.1}, r"rotation \(R\) must be a rotation matrix"),
    "mirrored": ({"R": np.diag([1.0, 1, -1])}, "must be a rotation matrix"),
    "exchanged": ({"T": -T.reshape(3, 1)}, "lies 0.12.* m to the left of the left one .*exchanged"),
    "vertical": ({"T": np.array([[0.0], [-0.1], [0.0]])}, "m above or below it.*turn the images by 90 degrees"),
    "before": ({"T": np.array([[0.0], [0.0], [-0.1]])}, "m before it"),
    "nowhere": ({"T": np.zeros((3, 1))}, "must not be 0"),
    "coefficients": ({"D1": np.full(7, 0.1)}, "d1 of a pinhole camera must hold 0, 4, 5, 8, 12, 14 numbers, got 7"),
    "focal": ({"K2": np.diag([-700.0, 700, 1])}, "k2 must begin with a positive focal length, got -700"),
    "not finite": ({"D2": np.array([0.1, np.nan, 0, 0, 0])}, "d2 must hold finite numbers"),
    "size": ({"image_width": 640.5}, "whole numbers of pixels, got 640.5"),
    "unit": ({"unit": "furlong"}, "unit must be one of m, cm, mm, in, got 'furlong'"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_contradicts_itself_is_refused_by_name(tmp_path, name):
    change, words = WRONG[name]
    path = tmp_path / "stereo.yml"
    path.write_text(opencv(".yml", {"image_width": WIDTH, "image_height": HEIGHT, **basic(), **change}))
    with pytest.raises(FileError, match=words) as caught:
        read_rig(path)
    assert "stereo.yml" in str(caught.value) and "\n" not in str(caught.value)


def test_rectified_cameras_that_contradict_the_rest_are_refused(tmp_path):
    path = tmp_path / "stereo.yml"
    rectified = rectified_cameras()
    for change, words in (
        (
            {"P2": rectified["P2"] * [[1, 1, 1, 1.5], [1] * 4, [1] * 4]},
            "T is 0.12.* long, but p1 and p2 have a baseline of 0.18",
        ),
        ({"P2": rectified["P2"] * [[1, 1, 1, -1], [1] * 4, [1] * 4]}, "p2 must lie to the right of p1.*exchanged"),
        ({"P2": rectified["P2"] * [[1.1, 1, 1, 1.1], [1] * 4, [1] * 4]}, "p1 and p2 must share fx, as rectified"),
        ({"P2": rectified["P2"] + [[0] * 4, [0, 0, 3, 0], [0] * 4]}, "p1 and p2 must share cy, as rectified"),
    ):
        path.write_text(opencv(".yml", {**basic(), **rectified, **change}))
        with pytest.raises(FileError, match=words):
            read_rig(path)


def test_views_that_are_exchanged_can_be_turned(tmp_path):
    path = tmp_path / "stereo.yml"
    turned = {"K1": K2, "D1": D2, "K2": K1, "D2": D1, "R": R.T, "T": (-R.T @ T).reshape(3, 1)}
    path.write_text(opencv(".yml", {"width": WIDTH, "height": HEIGHT, **turned}))
    with pytest.raises(FileError, match="exchanged"):
        read_rig(path)
    check(read_rig(path, exchange=True))


def test_odd_cameras_are_warned_of(tmp_path):
    path = tmp_path / "stereo.yml"
    path.write_text(opencv(".yml", {"width": 300, "height": HEIGHT, **basic()}))
    with pytest.warns(
        StereokitWarning, match="principal point of the left camera outside of the image: cx is 321.25 of 300"
    ):
        read_rig(path)
    away = cv2.Rodrigues(np.array([0, 0.9, 0]))[0]
    with pytest.warns(StereokitWarning, match="look 52 degrees apart"):
        StereoRig(Camera(K1), Camera(K2), away, away @ (-0.1, 0, 0.045))


HOSTILE = {
    "bomb.yml": "a: &a [1,1,1,1,1,1,1,1,1]\n"
    + "".join(f"{chr(98 + n)}: &{chr(98 + n)} [{','.join(['*' + chr(97 + n)] * 9)}]\n" for n in range(9))
    + "K1: *j\nK2: *j\n",
    "merge.yml": "a: &a {x: 1}\n" + "".join(f"b{n}: &b{n} {{<<: [{', '.join(['*a'] * 9)}]}}\n" for n in range(9)),
    "deep.yml": "K1: " + "[" * 50000,
    "closed.yml": "K1: " + "[" * 50000 + "]" * 50000,
    "object.yml": "K1: !!python/object/apply:os.system ['touch hacked']\n",
    "tagged.yml": "K1: !!python/object/apply:os.system ['touch hacked']\nP1: 3\nP2: 4\n",
    "keys.yml": "? [1, 2]\n: 3\nK1: 4\n",
    "digits.yml": "K1: " + "9" * 6000 + "\nK2: 1\n",
    "laughs.xml": '<!DOCTYPE l [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]>\n<opencv_storage>&b;</opencv_storage>',
    "deep.xml": "<opencv_storage>" + "<a>" * 5000 + "</a>" * 5000 + "</opencv_storage>",
    "cut.xml": "<opencv_storage><K1",
    "deep.json": '{"K1": ' + "[" * 100000,
    "list.json": "{}",
    "nan.json": '{"K1": NaN, "K2": [Infinity]}',
    "many.yml": "K1: [" + "1," * 20000 + "1]\nK2: 3\n",
    "keys.json": json.dumps({f"k{n}": n for n in range(40000)}),
    "large.yml": "K1: 3\n" + " " * 2**20,
    "wide.conf": "[LEFT_CAM_HD]\nfx=" + "1" * 5000 + "\n[RIGHT_CAM_HD]\nfx=1\n[STEREO]\nBaseline=1\n",
    "again.conf": "[LEFT_CAM_HD]\nfx=%(fx)s\n[RIGHT_CAM_HD]\nfx=%(fx)s\n",
    "text.yml": "hello\n",
    "empty.yml": "",
    "time.yml": "2001-99-99: 1\nK1: 2001-12-32\n",
    "bytes.yml": "\x00\x01",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_whatever_a_file_holds_is_one_line(tmp_path, name, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / name
    path.write_text(HOSTILE[name])
    with pytest.raises(FileError) as caught:
        read_rig(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 900
    assert not (tmp_path / "hacked").exists()


def test_archives_that_are_none(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("K1.npy", b"\0" * 2**24)
    with pytest.raises(FileError, match="arrays are too large"):
        read_rig(tmp_path / "bomb.npz")
    np.savez(tmp_path / "object.npz", K1=np.array([object()], dtype=object), allow_pickle=True)
    (tmp_path / "cut.npz").write_bytes((tmp_path / "object.npz").read_bytes()[:60])
    np.savez(tmp_path / "empty.npz", a=3)
    for name in ("object.npz", "cut.npz", "empty.npz"):
        with pytest.raises(FileError) as caught:
            read_rig(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_a_file_that_is_none_of_them_says_what_was_looked_for(tmp_path):
    (tmp_path / "notes.yaml").write_text("camera: mine\nlens: good\n")
    with pytest.raises(
        FileError,
        match=r"no calibration known here; known are OpenCV's YAML, XML, JSON and npz.*ROS camera_info .*Kalibr",
    ):
        read_rig(tmp_path / "notes.yaml")
    with pytest.raises(
        FileError, match=r"no calibration in the folder.*looked for left.yaml and right.yaml, .*calib.txt"
    ):
        read_rig(tmp_path)
    with pytest.raises(FileError, match="no such file"):
        read_rig(tmp_path / "missing.yml")
    (tmp_path / "boof.yaml").write_text("model: pinhole\nleftToRight:\n  x: 1\n")
    with pytest.raises(FileError, match="looks like a BoofCV calibration, which is not read; known are"):
        read_rig(tmp_path / "boof.yaml")
