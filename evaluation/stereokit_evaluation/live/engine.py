"""Matching of the newest frame of a source, over and over, with settings that may change meanwhile."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit import Calibration, Disparity, Matcher
from stereokit.errors import OptionError, StereokitError, shown
from stereokit.images.check import check_number
from stereokit.images.intensity import display_8bit
from stereokit.notices import collecting
from stereokit.result import color_range
from stereokit.rig import Rectification
from stereokit_evaluation.live.source import Frame, Source

__all__ = ["CHANGEABLE", "Engine", "View"]

CHANGEABLE = ("method", "max_disparity", "min_disparity", "scale", "refiner", "confidence")
"""Settings that may change while frames come in; ``confidence`` is the least that is shown, from 0 to 1."""

_RECENT = 2.0  # seconds over which the rate is counted
_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 85]


@dataclass(frozen=True, eq=False)
class View:
    """A matched frame as it is shown.

    Attributes
    ----------
    frame : Frame
    result : Disparity
    left, disparity : bytes
        JPEG pictures.
    span : (float, float)
        Disparities of the first and the last colour, pixels.
    milliseconds : float
        Of matching.
    """

    frame: Frame
    result: Disparity
    left: bytes
    disparity: bytes
    span: tuple[float, float]
    milliseconds: float


class Engine:
    """A thread that matches the newest frame of a source.

    Parameters
    ----------
    source : Source
        Closed with the engine.
    calibration : Calibration or None
        For depth.
    listener : callable or None
        Called, from the engine's thread, after each frame and at the end.
    threads, device
        As for `stereokit.Matcher`.
    rectify : callable or None
        For raw cameras: returns the rectification of images of a size (width, height), which gives the calibration too.
    **settings
        Of `CHANGEABLE`, and options of the stages, which stay.

    Raises
    ------
    OptionError
        If a setting breaks its rule.
    """

    def __init__(
        self, source: Source, calibration: Calibration | None = None, listener: Callable[[], None] | None = None,
        threads: int | None = None, device: str = "auto",
        rectify: Callable[[tuple[int, int]], Rectification] | None = None, **settings: Any,
    ) -> None:  # fmt: skip
        defaults = {
            "method": "census+sgm", "max_disparity": 128, "min_disparity": 0, "scale": 1.0, "refiner": None,
            "confidence": 0.0,
        }  # fmt: skip
        self.source = source
        self.calibration = calibration
        self._rectify = rectify
        self._rectification: Rectification | None = None
        self.listener = listener or (lambda: None)
        self.settings = {name: settings.pop(name, value) for name, value in defaults.items()}
        self._fixed = {"threads": threads, "device": device, **settings}
        self._matcher = self._new_matcher(self.settings)
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._done: deque[float] = deque()
        self.view: View | None = None
        self.matched = 0
        self.message = ""
        self.ended = False
        self.thread = threading.Thread(target=self._run, name="stereokit live", daemon=True)

    def _new_matcher(self, settings: dict[str, Any]) -> Matcher:
        check_number("confidence", settings["confidence"], 0, 1)
        options = {name: value for name, value in settings.items() if name != "confidence"}
        if options["scale"] == 1 and options["refiner"] == "linear":
            options["refiner"] = None
        return Matcher(**options, confidence=True, **self._fixed)

    def start(self) -> None:
        """Begin."""
        self.thread.start()

    def close(self) -> None:
        """End, after the frame that is being matched."""
        self._stop.set()
        self.source.close()
        if self.thread.is_alive():
            self.thread.join()

    def change(self, **changes: Any) -> dict[str, Any]:
        """Change settings from the next frame on; return all of them.

        Raises
        ------
        OptionError
            If there is no such setting, or a value breaks its rule; then nothing changes.
        """
        for name in changes:
            if name not in CHANGEABLE:
                raise OptionError(f"settings that can change are {', '.join(CHANGEABLE)}, got {shown(name)}")
        settings = {**self.settings, **changes}
        matcher = self._new_matcher(settings)
        with self._lock:
            self.settings, self._matcher = settings, matcher
        return settings

    @property
    def rate(self) -> float:
        """Frames per second, over the last two seconds."""
        now = time.monotonic()
        recent = [moment for moment in list(self._done) if now - moment < _RECENT]
        return len(recent) / _RECENT

    def at(self, x: int, y: int) -> dict[str, Any]:
        """Return what is known of a pixel of the view.

        Parameters
        ----------
        x, y : int
            Column and row.

        Returns
        -------
        dict
            ``disparity`` (pixels), ``confidence``, ``measured``, and with a calibration ``depth`` (metres); None where
            there is none.

        Raises
        ------
        OptionError
            If there is no view yet, or the pixel lies outside.
        """
        view = self.view
        if view is None:
            raise OptionError("no frame has been matched yet")
        result = view.result
        height, width = result.disparity.shape
        if not (0 <= x < width and 0 <= y < height):
            raise OptionError(f"x and y must lie in the map of {width}x{height} pixels, got {x} and {y}")
        disparity = float(result.disparity[y, x])
        depth = None
        if self.calibration is not None:
            camera = replace(self.calibration, width=None, height=None)  # for a part of a map
            depth = float(camera.disparity_to_depth(result.disparity[y : y + 1, x : x + 1])[0, 0])
        assert result.confidence is not None
        numbers = {"disparity": disparity, "confidence": float(result.confidence[y, x]), "depth": depth}
        finite = {name: value if value is not None and np.isfinite(value) else None for name, value in numbers.items()}
        return {"number": view.frame.number, "x": x, "y": y, "measured": bool(result.valid[y, x]), **finite}

    def state(self) -> dict[str, Any]:
        """Return what the page shows beside the pictures, as plain values."""
        view = self.view
        shape = None if view is None else view.result.disparity.shape
        return {
            "number": None if view is None else view.frame.number,
            "width": None if shape is None else shape[1],
            "height": None if shape is None else shape[0],
            "fps": round(self.rate, 1),
            "milliseconds": None if view is None else round(view.milliseconds, 1),
            "dropped": self.source.dropped,
            "density": None if view is None else round(view.result.density, 4),
            "span": None if view is None else [round(value, 1) for value in view.span],
            "calibrated": self.calibration is not None,
            "message": self.message,
            "ended": self.ended,
            "settings": self.settings,
        }

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                frame = self.source.newest()
                if frame is None:
                    break
                self._match(frame)
                self.listener()
        except StereokitError as error:
            self.message = str(error)
        except Exception as error:  # the page shall say why it stands still
            self.message = f"{type(error).__name__}: {error}"
        finally:
            release = getattr(self.source, "close_captures", None)
            if release is not None:
                release()
            self.ended = True
            self.listener()

    def _match(self, frame: Frame) -> None:
        with self._lock:
            matcher, settings = self._matcher, self.settings
        lines: list[str] = []
        begin = time.perf_counter()
        try:
            with collecting(lines.append):
                left, right, masks = self._rectified(frame)
                result = matcher(left, right, **masks)
        except StereokitError as error:  # such as a refiner that cannot be loaded: say so, and go on
            self.message = str(error)
            return
        milliseconds = 1000 * (time.perf_counter() - begin)
        self.message = lines[0] if lines else ""
        span = color_range(result.disparity)
        self.view = View(
            frame, result, _jpeg(left), _jpeg(_picture(result, settings["confidence"], span)), span, milliseconds
        )
        self.matched += 1
        now = time.monotonic()
        self._done.append(now)
        while self._done and now - self._done[0] > _RECENT:
            self._done.popleft()

    def _rectified(self, frame: Frame) -> tuple[Any, Any, dict[str, NDArray[np.bool_]]]:
        """Return the images of a frame as they are matched, and their masks."""
        if self._rectify is None:
            return frame.left, frame.right, {}
        size = frame.left.shape[1], frame.left.shape[0]
        if self._rectification is None or self._rectification.raw_size != size:
            self._rectification = self._rectify(size)
            self.calibration = self._rectification.calibration
        return (*self._rectification(frame.left, frame.right), self._rectification.masks)


def _picture(result: Disparity, least: float, span: tuple[float, float]) -> NDArray[np.uint8]:
    """Return the map in colours, black where it is less sure than `least`."""
    assert result.confidence is not None
    picture = result.color(*span)
    if least > 0:
        picture[~(result.confidence >= least) | ~result.valid] = 0
    return picture


def _jpeg(image: NDArray[Any]) -> bytes:
    pixels = display_8bit(image)
    good, data = cv2.imencode(".jpg", pixels[:, :, 2::-1] if pixels.ndim == 3 else pixels, _QUALITY)
    assert good
    return data.tobytes()
