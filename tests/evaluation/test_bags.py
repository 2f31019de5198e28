"""ROS bags that the tests write: pairs come out by their stamps, maps go in with depth and camera_info."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags")

from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from stereokit.calibration import Calibration
from stereokit.errors import FileError, OptionError
from stereokit_evaluation.batch.bags import Bag, is_bag, write_bag

MS = 1_000_000
START = 1_700_000_000 * 1_000_000_000
LEFT, RIGHT = "/stereo/left/image_rect", "/stereo/right/image_rect"


class Messages:
    """Messages of one ROS version."""

    def __init__(self, ros):
        self.ros = ros
        self.store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)

    def header(self, stamp, frame="cam"):
        types = self.store.types
        time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        more = {"seq": 0} if self.ros == 1 else {}
        return types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **more)

    def image(self, stamp, data, encoding, width, height, step, big=0):
        return self.store.types["sensor_msgs/msg/Image"](
            header=self.header(stamp), height=height, width=width, encoding=encoding, is_bigendian=big, step=step,
            data=np.frombuffer(data, np.uint8),
        )  # fmt: skip

    def gray(self, stamp, pixels):
        return self.image(stamp, pixels.tobytes(), "mono8", pixels.shape[1], pixels.shape[0], pixels.shape[1])

    def compressed(self, stamp, pixels, form=".png"):
        data = cv2.imencode(form, pixels)[1].reshape(-1)
        return self.store.types["sensor_msgs/msg/CompressedImage"](
            header=self.header(stamp), format=form[1:], data=data
        )

    def info(self, stamp, projection, size=(30, 20)):
        roi = self.store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        names = "DKRP" if self.ros == 1 else "dkrp"
        arrays = (np.zeros(5), np.eye(3).reshape(-1), np.eye(3).reshape(-1), np.asarray(projection, float))
        return self.store.types["sensor_msgs/msg/CameraInfo"](
            header=self.header(stamp), height=size[1], width=size[0], distortion_model="plumb_bob", binning_x=0,
            binning_y=0, roi=roi, **dict(zip(names, arrays, strict=True)),
        )  # fmt: skip


def written(path, messages, content):
    """Write (topic, log time, message) and return the path."""
    store = messages.store
    if messages.ros == 1:
        writer = Writer1(path.with_suffix(".bag"))
        serialize = store.serialize_ros1
    else:
        writer = Writer2(
            path, version=8, storage_plugin=StoragePlugin.MCAP if messages.ros == 2 else StoragePlugin.SQLITE3
        )
        serialize = store.serialize_cdr
    with writer:
        connections = {}
        for topic, time, message in content:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], time, serialize(message, kind))
    return path.with_suffix(".bag") if messages.ros == 1 else path


def picture(seed, size=(20, 30)):
    return np.random.default_rng(seed).integers(0, 256, size, np.uint8)


P = (100, 0, 15, 0, 0, 101, 10, 0, 0, 0, 1, 0)
Q = (100, 0, 17, -12, 0, 101, 10, 0, 0, 0, 1, 0)


@pytest.mark.parametrize("ros", [1, 2, 3], ids=["ros1", "mcap", "sqlite3"])
def test_pairs_come_by_their_stamps(tmp_path, ros):
    """Right images come late and one is lost; stamps differ by a little; the bag's own times say nothing."""
    messages = Messages(ros)
    content = []
    for k in range(4):
        stamp = START + 100 * MS * k
        content.append((LEFT, stamp + 30 * MS, messages.gray(stamp, picture(k))))
        if k != 2:
            content.append((RIGHT, stamp + 60 * MS, messages.gray(stamp + 2 * MS, picture(10 + k))))
        content.append(("/stereo/left/camera_info", stamp, messages.info(stamp, P)))
        content.append(("/stereo/right/camera_info", stamp, messages.info(stamp, Q)))
        content.append(("/front/image_raw", stamp, messages.gray(stamp, picture(99))))
    bag = Bag(written(tmp_path / "run", messages, content))
    assert bag.topics == [LEFT, RIGHT]
    assert bag.expected == 3
    frames = list(bag.frames())
    assert [frame.name for frame in frames] == [str(START + 100 * MS * k) for k in (0, 1, 3)]
    for frame, k in zip(frames, (0, 1, 3), strict=True):
        assert np.array_equal(frame.left, picture(k))
        assert np.array_equal(frame.right, picture(10 + k))
    assert bag.unpaired == 1
    assert [frame.name for frame in bag.frames(lambda name: name == frames[1].name)] == [frames[1].name]
    expected = Calibration(fx=100, fy=101, cx0=15, cy=10, cx1=17, baseline_m=0.12, width=30, height=20)
    assert bag.calibration() == expected
    assert is_bag(bag.path)


def encoded(image):
    """Return what each encoding stores of a colour picture, and what must come out."""
    b, g, r = (np.ascontiguousarray(image[:, :, 2 - k]) for k in range(3))
    alpha = np.full_like(b, 7)
    deep = image[:, :, 0].astype(np.uint16) * 257
    return {
        "rgb8": (image, image), "bgr8": (image[:, :, ::-1], image), "8UC3": (image[:, :, ::-1], image),
        "rgba8": (np.dstack([image, alpha]), image), "bgra8": (np.dstack([b, g, r, alpha]), image),
        "mono8": (r, r), "8UC1": (r, r), "mono16": (deep.astype("<u2"), deep), "16UC1": (deep.astype("<u2"), deep),
    }  # fmt: skip


def test_encodings_with_padded_rows(tmp_path):
    messages = Messages(2)
    image = picture(0, (6, 9, 3))
    for k, (encoding, (stored, expected)) in enumerate(encoded(image).items()):
        rows = np.ascontiguousarray(stored).view(np.uint8).reshape(6, -1)
        padded = np.hstack([rows, np.full((6, 5), 200, np.uint8)])
        content = [
            (topic, START, messages.image(START, padded.tobytes(), encoding, 9, 6, padded.shape[1]))
            for topic in (LEFT, RIGHT)
        ]
        (frame,) = Bag(written(tmp_path / str(k), messages, content)).frames()
        assert frame.reason == ""
        assert np.array_equal(frame.left, expected), encoding
        assert frame.left.dtype == expected.dtype


def test_big_endian_bayer_yuv_and_compressed(tmp_path):
    messages = Messages(2)
    deep = picture(1, (6, 8)).astype(np.uint16) * 250
    flat = np.full((6, 8, 3), (200, 100, 50), np.uint8)
    mosaic = np.tile(np.array([[200, 100], [100, 50]], np.uint8), (3, 4))  # RGGB
    # ITU-R BT.601, limited range
    luma = 16 + 0.257 * 200 + 0.504 * 100 + 0.098 * 50
    blue = 128 - 0.148 * 200 - 0.291 * 100 + 0.439 * 50
    red = 128 + 0.439 * 200 - 0.368 * 100 - 0.071 * 50
    packed = np.tile(np.rint([luma, blue, luma, red]).astype(np.uint8), (6, 4))
    rows = {
        "big": messages.image(START, deep.astype(">u2").tobytes(), "mono16", 8, 6, 16, big=1),
        "bayer": messages.image(START, mosaic.tobytes(), "bayer_rggb8", 8, 6, 8),
        "yuv": messages.image(START, packed.tobytes(), "yuv422_yuy2", 8, 6, 16),
        "png": messages.compressed(START, flat[:, :, ::-1]),
    }
    frames = {}
    for name, message in rows.items():
        (frames[name],) = Bag(written(tmp_path / name, messages, [(t, START, message) for t in (LEFT, RIGHT)])).frames()
    assert np.array_equal(frames["big"].left, deep)
    assert np.array_equal(frames["png"].right, flat)
    assert np.abs(frames["bayer"].left[2:4, 2:6].astype(int) - flat[2:4, 2:6]).max() <= 1
    assert np.abs(frames["yuv"].left.astype(int) - flat).max() <= 3


def test_frames_that_cannot_be_decoded_cost_nobody_else(tmp_path):
    messages = Messages(2)
    good = messages.gray(START + 100 * MS, picture(0))
    for k, bad in enumerate(
        (
            messages.image(START, b"1234", "mono8", 30, 20, 30),
            messages.image(START, bytes(600), "strange", 30, 20, 30),
            messages.image(START, bytes(600), "mono8", 30, 20, 3),
        )
    ):
        content = [(topic, START, bad) for topic in (LEFT, RIGHT)] + [(topic, START, good) for topic in (LEFT, RIGHT)]
        first, second = Bag(written(tmp_path / str(k), messages, content)).frames()
        assert first.left is None
        assert "cannot be decoded" in first.reason
        assert second.left is not None


def test_topics_are_told_when_it_is_not_clear(tmp_path):
    messages = Messages(2)
    names = ("/a/left/image_raw", "/a/right/image_raw", "/b/cam0/image", "/b/cam1/image", "/c/image")
    path = written(tmp_path / "many", messages, [(name, START, messages.gray(START, picture(0))) for name in names])
    with pytest.raises(OptionError, match=r"topics must be given as LEFT,RIGHT: .* more than two that fit.*/c/image"):
        Bag(path)
    assert Bag(path, ["/c/image", "/b/cam0/image"]).topics == ["/c/image", "/b/cam0/image"]
    with pytest.raises(OptionError, match="no image topic '/x'; it has /a/left"):
        Bag(path, ["/x", "/c/image"])
    for wrong in (["/c/image"], ["/c/image", "/c/image"]):
        with pytest.raises(OptionError, match="topics must be two names"):
            Bag(path, wrong)
    raw_and_rectified = [f"/a/{side}/image_{kind}" for kind in ("raw", "rect") for side in ("left", "right")]
    content = [(name, START, messages.gray(START, picture(0))) for name in raw_and_rectified]
    path = written(tmp_path / "both", messages, content)
    assert Bag(path).topics == ["/a/left/image_rect", "/a/right/image_rect"]
    assert Bag(path).calibration() is None


@pytest.mark.parametrize("content", [b"", b"no bag", b"\x89MCAP0\r\n cut"])
@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_what_is_no_bag_is_refused_in_one_line(tmp_path, suffix, content):
    path = tmp_path / f"run{suffix}"
    with pytest.raises(FileError, match="no such file"):
        Bag(path)
    path.write_bytes(content)
    with pytest.raises(FileError) as caught:
        list(Bag(path).frames())
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_maps_in_a_bag(tmp_path):
    camera = Calibration(fx=100, fy=101, cx0=15, cy=10, cx1=17, baseline_m=0.12, width=30, height=20)
    maps = [np.full((20, 30), 5 + k, np.float32) for k in range(3)]
    maps[1][3, 4] = np.nan
    path = tmp_path / "out"
    stamps = [START + 50 * MS * k for k in range(3)]
    assert write_bag(path, zip(stamps, maps, strict=True), camera, "left_optical", (0, 64)) == 3
    messages = {"disparity": [], "depth": [], "camera_info": []}
    with AnyReader([path]) as reader:
        for connection, time, data in reader.messages():
            name = connection.topic.removeprefix("/stereokit/")
            messages[name].append((time, reader.deserialize(data, connection.msgtype)))
    for k, (stamp, disparity) in enumerate(zip(stamps, maps, strict=True)):
        time, message = messages["disparity"][k]
        assert time == stamp
        assert message.header.frame_id == "left_optical"
        values = message.image.data.view("<f4").reshape(20, 30)
        valid = values >= message.min_disparity
        assert np.array_equal(valid, np.isfinite(disparity))
        depth = messages["depth"][k][1].data.view("<f4").reshape(20, 30)
        np.testing.assert_allclose(message.f * message.t / values[valid], depth[valid], rtol=1e-6)  # REP 118
        np.testing.assert_allclose(depth, 100 * 0.12 / (disparity + 2), rtol=1e-6)
        assert list(messages["camera_info"][k][1].p) == [100, 0, 15, 0, 0, 101, 10, 0, 0, 0, 1, 0]
    with pytest.raises(FileError, match="is there already"):
        write_bag(path, [], camera)
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_bag_that_fails_half_way_leaves_nothing(tmp_path):
    def maps():
        yield START, np.zeros((2, 2), np.float32)
        raise FileError("the source is gone")

    camera = Calibration(fx=100, fy=100, cx0=1, cy=1, baseline_m=0.1)
    with pytest.raises(FileError, match="the source is gone"):
        write_bag(tmp_path / "out", maps(), camera)
    assert list(tmp_path.iterdir()) == []
