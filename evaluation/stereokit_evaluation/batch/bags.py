"""Stereo pairs from a ROS bag (version 1, or 2 in sqlite3 or MCAP), and maps into one; no ROS is needed.

Frames are named by their stamp, nanoseconds. Images of the two topics whose stamps agree within half of a short
exposure (5 ms by default) are a pair. The bag is read once, from its beginning to its end.

Message types: sensor_msgs/Image, CompressedImage and CameraInfo, stereo_msgs/DisparityImage (ROS wiki and REP 118:
depth images are 32FC1, metres, NaN where there is none). The library is rosbags (extra ``ros``).
"""

from __future__ import annotations

import re
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.calibration import Calibration
from stereokit.errors import FileError, InputError, OptionError, StereokitError
from stereokit.io import parsing
from stereokit_evaluation.batch.video import FramePair, Frames

__all__ = ["BAG_SUFFIXES", "Bag", "is_bag", "write_bag"]

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
TOLERANCE_NS = 5_000_000
_IMAGE, _COMPRESSED, _INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_SIDES = re.compile(r"(?<![a-z])(left|right|cam0|cam1|infra1|infra2|camera_0|camera_1)(?![a-z0-9])", re.IGNORECASE)
_RIGHT = {"right", "cam1", "infra2", "camera_1"}
_PLAIN = {"mono8": 1, "8uc1": 1, "rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4}
_DEEP = {"mono16": 1, "16uc1": 1, "rgb16": 3, "bgr16": 3}
_BAYER = {
    "bayer_rggb8": cv2.COLOR_BayerRGGB2RGB, "bayer_bggr8": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2RGB, "bayer_grbg8": cv2.COLOR_BayerGRBG2RGB,
}  # fmt: skip
_YUV = {
    "yuv422": cv2.COLOR_YUV2RGB_UYVY, "uyvy": cv2.COLOR_YUV2RGB_UYVY, "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
    "yuyv": cv2.COLOR_YUV2RGB_YUY2,
}  # fmt: skip


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a file of `BAG_SUFFIXES`, or a folder with ``metadata.yaml`` and such a file."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() and any(f.suffix in BAG_SUFFIXES for f in path.iterdir())
    return path.suffix.lower() in BAG_SUFFIXES


def _reader(path: Path) -> Any:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise OptionError("ROS bags need the package rosbags: pip install 'stereokit[ros]'") from None
    if not path.exists():
        raise FileError(f"no such file: {str(path)!r}")
    with parsing(path, "ROS bag"):
        return AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))


class Bag(Frames):
    """The pairs of a bag.

    Parameters
    ----------
    path : Path
    topics : (left, right) or None
        Names of the image topics; None takes the only two whose names differ by left and right, cam0 and cam1, or
        infra1 and infra2, rectified ones first.
    tolerance_ns : int
        Largest difference of the stamps of a pair, nanoseconds.

    Raises
    ------
    FileError
        If the file is missing or is no bag.
    OptionError
        If there are no such topics, or it is not clear which are meant; or rosbags is not installed.
    """

    def __init__(self, path: Path, topics: Sequence[str] | None = None, tolerance_ns: int = TOLERANCE_NS) -> None:
        self.path = path
        self.paths = [path]
        self.tolerance_ns = tolerance_ns
        self.unpaired = 0
        with parsing(path, "ROS bag"), _reader(path) as reader:
            kinds = {c.topic: c.msgtype for c in reader.connections}
            counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        images = sorted(topic for topic, kind in kinds.items() if kind in (_IMAGE, _COMPRESSED))
        self.topics = _chosen(path, images, topics)
        self._infos = [_info_topic(topic, kinds) for topic in self.topics]
        self.expected = min(counts[topic] for topic in self.topics)

    def frames(self, wanted: Callable[[str], bool] = lambda name: True) -> Iterator[FramePair]:
        """Yield the pairs whose names are wanted, in the order of their stamps as they were recorded."""
        waiting: tuple[deque[tuple[int, Any]], deque[tuple[int, Any]]] = (deque(), deque())
        self.unpaired = 0
        with parsing(self.path, "ROS bag"), _reader(self.path) as reader:
            connections = [c for c in reader.connections if c.topic in self.topics]
            for connection, _, data in reader.messages(connections=connections):
                message = reader.deserialize(data, connection.msgtype)
                waiting[self.topics.index(connection.topic)].append((_stamp(message), message))
                while waiting[0] and waiting[1]:
                    (left_time, left), (right_time, right) = waiting[0][0], waiting[1][0]
                    if abs(left_time - right_time) > self.tolerance_ns:
                        waiting[0 if left_time < right_time else 1].popleft()
                        self.unpaired += 1
                        continue
                    waiting[0].popleft(), waiting[1].popleft()
                    name = f"{left_time:019d}"
                    if wanted(name):
                        yield _pair(name, left, right)
        self.unpaired += len(waiting[0]) + len(waiting[1])

    def calibration(self) -> Calibration | None:
        """Return the rectified pair's geometry from the first camera_info of either camera, None without them.

        Raises
        ------
        StereokitError
            If the two do not describe a rectified pair.
        """
        if None in self._infos:
            return None
        infos: dict[str, Any] = {}
        with parsing(self.path, "ROS bag"), _reader(self.path) as reader:
            for connection, _, data in reader.messages([c for c in reader.connections if c.topic in self._infos]):
                infos.setdefault(connection.topic, reader.deserialize(data, connection.msgtype))
                if len(infos) == len(set(self._infos)):
                    break
        if len(infos) < 2:
            return None
        left, right = (infos[str(topic)] for topic in self._infos)
        p, q = (
            np.asarray(info.p if hasattr(info, "p") else info.P, np.float64).reshape(3, 4) for info in (left, right)
        )
        if not p[0, 0] > 0 or not q[0, 3] < 0:
            return None  # cameras that were not calibrated have zeros
        return Calibration(
            fx=float(p[0, 0]), fy=float(p[1, 1]), cx0=float(p[0, 2]), cy=float(p[1, 2]), cx1=float(q[0, 2]),
            baseline_m=float(-q[0, 3] / q[0, 0]), width=int(left.width), height=int(left.height),
        )  # fmt: skip


def _chosen(path: Path, images: list[str], topics: Sequence[str] | None) -> list[str]:
    known = ", ".join(images) or "none"
    if topics is not None:
        if len(topics) != 2 or topics[0] == topics[1]:
            raise OptionError(f"topics must be two names, LEFT,RIGHT, got {','.join(topics)!r}")
        for topic in topics:
            if topic not in images:
                raise OptionError(f"topics: {str(path)!r} has no image topic {topic!r}; it has {known}")
        return list(topics)
    pairs: dict[str, dict[bool, str]] = {}
    for topic in images:
        if match := _SIDES.search(topic):
            is_right = match[1].lower() in _RIGHT
            pairs.setdefault(topic[: match.start()] + "*" + topic[match.end() :], {})[is_right] = topic
    complete = {name: sides for name, sides in pairs.items() if len(sides) == 2}
    rectified = {name: sides for name, sides in complete.items() if "rect" in name}
    choice = rectified or complete
    plain = {name: sides for name, sides in choice.items() if not name.endswith("/compressed")}
    choice = plain or choice
    if len(choice) != 1:
        how = "no two" if not choice else "more than two"
        raise OptionError(
            f"topics must be given as LEFT,RIGHT: {str(path)!r} has {how} that fit; its images are {known}"
        )
    sides = next(iter(choice.values()))
    return [sides[False], sides[True]]


def _info_topic(topic: str, kinds: dict[str, str]) -> str | None:
    """Return the camera_info beside an image topic."""
    base = topic.removesuffix("/compressed").rpartition("/")[0]
    name = f"{base}/camera_info"
    return name if kinds.get(name) == _INFO else None


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _pair(name: str, left: Any, right: Any) -> FramePair:
    try:
        return FramePair(name, _image(left), _image(right))
    except (StereokitError, ValueError, cv2.error) as error:
        return FramePair(name, None, None, f"the frame cannot be decoded: {error}")


def _image(message: Any) -> NDArray[Any]:
    """Return the picture of a message, (H, W) or (H, W, 3) uint8 or uint16, RGB."""
    if message.__msgtype__ == _COMPRESSED:
        picture = cv2.imdecode(np.asarray(message.data, np.uint8), cv2.IMREAD_UNCHANGED)
        if picture is None:
            raise InputError(f"format {message.format!r}")
        return np.ascontiguousarray(picture[:, :, 2::-1]) if picture.ndim == 3 else picture
    encoding = str(message.encoding).lower()
    height, width, step = int(message.height), int(message.width), int(message.step)
    if encoding in _DEEP:
        dtype: np.dtype[Any] = np.dtype(">u2" if message.is_bigendian else "<u2")
        channels = _DEEP[encoding]
    elif encoding in _PLAIN or encoding in _BAYER or encoding in _YUV:
        dtype, channels = np.dtype(np.uint8), _PLAIN.get(encoding, 2 if encoding in _YUV else 1)
    else:
        raise InputError(f"encoding {message.encoding!r}")
    line = width * channels * dtype.itemsize
    data = np.asarray(message.data, np.uint8)
    if step < line or height * step > data.size or height < 1 or width < 1:
        raise InputError(f"{width}x{height} pixels of {encoding} in rows of {step} bytes, got {data.size} bytes")
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :line])
    pixels = rows.view(dtype).reshape(height, width, channels)
    if encoding in _BAYER:
        return np.asarray(cv2.cvtColor(pixels[:, :, 0], _BAYER[encoding]))
    if encoding in _YUV:
        return np.asarray(cv2.cvtColor(pixels, _YUV[encoding]))
    pixels = pixels.astype(dtype.newbyteorder("="), copy=False)
    if channels == 1:
        return np.ascontiguousarray(pixels[:, :, 0])
    return np.ascontiguousarray(pixels[:, :, 2::-1] if encoding.startswith(("bgr", "8uc3")) else pixels[:, :, :3])


def write_bag(
    path: Path, maps: Iterable[tuple[int, NDArray[np.float32]]], calibration: Calibration, frame_id: str = "left",
    limits: tuple[float, float] = (0.0, 128.0),
) -> int:  # fmt: skip
    """Write a ROS 2 bag (MCAP) with ``disparity``, ``depth`` and ``camera_info`` under ``/stereokit``.

    Parameters
    ----------
    path : Path
        Folder of the bag, which must not be there.
    maps : iterable of (stamp, disparity)
        Nanoseconds, and (H, W) float32, pixels, NaN where there is none.
    calibration : Calibration
        For depth and camera_info.
    frame_id : str
        Of the left camera's optical frame.
    limits : (low, high)
        Disparities that were searched, pixels.

    Returns
    -------
    int
        Number of maps.

    Raises
    ------
    FileError
        If the folder is there already or cannot be written.
    OptionError
        If rosbags is not installed.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise OptionError("ROS bags need the package rosbags: pip install 'stereokit[ros]'") from None
    if path.exists():
        raise FileError(f"{str(path)!r} is there already; a bag is not overwritten")
    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = {"disparity": "stereo_msgs/msg/DisparityImage", "depth": _IMAGE, "camera_info": _INFO}
    part = path.with_name(f".{path.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    count = 0
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with Writer(part, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
            topics = {
                name: writer.add_connection(f"/stereokit/{name}", kind, typestore=store) for name, kind in kinds.items()
            }
            for stamp, disparity in maps:
                messages = _messages(store.types, stamp, disparity, calibration, frame_id, limits)
                for name, message in messages.items():
                    writer.write(topics[name], stamp, store.serialize_cdr(message, kinds[name]))
                count += 1
        part.rename(path)
    except OSError as error:
        raise FileError(f"cannot write {str(path)!r}: {error.strerror or error}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return count


def _messages(
    types: Any, stamp: int, disparity: NDArray[np.float32], calibration: Calibration, frame_id: str,
    limits: tuple[float, float],
) -> dict[str, Any]:  # fmt: skip
    height, width = disparity.shape
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 1_000_000_000, nanosec=stamp % 1_000_000_000)
    header = types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)
    everything = types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=0, y_offset=0, height=height, width=width, do_rectify=False
    )

    def image(pixels: NDArray[np.float32]) -> Any:
        little = np.ascontiguousarray(pixels, "<f4")
        return types[_IMAGE](
            header=header, height=height, width=width, encoding="32FC1", is_bigendian=0, step=4 * width,
            data=little.view(np.uint8).reshape(-1),
        )  # fmt: skip

    camera = calibration
    shift = float(camera.cx1 or camera.cx0) - camera.cx0
    known = np.where(np.isfinite(disparity), disparity, np.float32(limits[0] - 1))  # invalid lies below the minimum
    intrinsic = np.array([camera.fx, 0, camera.cx0, 0, camera.fy, camera.cy, 0, 0, 1.0])
    projection = np.array([camera.fx, 0, camera.cx0, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1.0, 0])
    return {
        # Z = f T / d holds for d with the principal points' difference added
        "disparity": types["stereo_msgs/msg/DisparityImage"](
            header=header, image=image(known + np.float32(shift)), f=camera.fx, t=camera.baseline_m,
            valid_window=everything, min_disparity=limits[0] + shift, max_disparity=limits[1] + shift, delta_d=1 / 16,
        ),
        "depth": image(camera.disparity_to_depth(disparity)),
        "camera_info": types[_INFO](
            header=header, height=height, width=width, distortion_model="plumb_bob", d=np.zeros(5), k=intrinsic,
            r=np.eye(3).reshape(-1), p=projection, binning_x=0, binning_y=0, roi=everything,
        ),
    }  # fmt: skip
