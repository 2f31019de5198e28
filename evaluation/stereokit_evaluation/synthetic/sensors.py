"""The imperfections of a pair of real cameras: blur, defocus, vignetting, noise, exposure, gamma, JPEG.

All sums are float64 in a fixed order, so that the bytes do not depend on the processor's vectors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["Sensor", "blurred", "compressed", "draw_sensors", "expose", "sensor_noise"]

Rng = np.random.Generator


@dataclass(frozen=True)
class Sensor:
    """One camera.

    Attributes
    ----------
    blur : float
        Standard deviation of the lens's blur, pixels.
    defocus, focus : float
        Blur that is added per pixel of disparity away from `focus`, pixels; bounded.
    exposure : float
        What light of mean 1 is multiplied by.
    vignette : float
        Loss of light in the corners, share.
    shot, read : float
        Noise: variance per light, and standard deviation in the dark; of the range 0..1.
    resample : float
        Blur after the noise, as rectification makes it, pixels.
    gamma : float
        Exponent that the light is coded with.
    black, contrast : float
        Offset and gain after coding, grey levels and factor.
    quality : int
        Of JPEG; 0 for none.
    """

    blur: float
    defocus: float
    focus: float
    exposure: float
    vignette: float
    shot: float
    read: float
    resample: float
    gamma: float
    black: float
    contrast: float
    quality: int


def draw_sensors(rng: Rng, harsh: float) -> tuple[Sensor, Sensor]:
    """Return a left and a right camera of one make; `harsh` in 0..1 is how bad they are."""
    blur = rng.uniform(0.25, 0.55 + 0.45 * harsh)
    gamma = float(rng.choice([0.45, 0.6, 1.0], p=[0.6, 0.25, 0.15]))
    shot, read = 10 ** rng.uniform(-4.6, -3.8 + 0.9 * harsh), 10 ** rng.uniform(-3.0, -2.5 + 0.6 * harsh)
    resample = float(rng.choice([0.0, rng.uniform(0.3, 0.6)], p=[0.45, 0.55]))
    vignette = rng.uniform(0, 0.15 + 0.3 * harsh)
    exposure = float(0.45 ** (1 / gamma) * np.exp(np.clip(rng.normal(0.0, 0.2 + 0.3 * harsh), -0.9, 0.7)))
    contrast = float(np.clip(np.exp(rng.normal(0.0, 0.15)), 0.4, 1.3)) * (
        rng.uniform(0.35, 0.8) if rng.random() < 0.15 else 1
    )
    black = float(rng.uniform(0, 14 + 20 * (1 - min(contrast, 1.0))))
    quality = int(rng.integers(72, 98)) if rng.random() < 0.25 + 0.2 * harsh else 0
    defocus = float(rng.uniform(0.003, 0.02)) if rng.random() < 0.08 + 0.12 * harsh else 0.0
    focus = float(rng.uniform(0.1, 0.9))
    differ = 0.25 + 0.75 * harsh
    pair = []
    for _ in range(2):
        pair.append(
            Sensor(
                blur=float(blur * np.exp(rng.normal(0, 0.12 * differ))),
                defocus=defocus,
                focus=focus,
                exposure=exposure * float(np.exp(rng.normal(0, 0.09 * differ))),
                vignette=float(vignette * rng.uniform(0.8, 1.2)),
                shot=float(shot),
                read=float(read),
                resample=float(resample * np.exp(rng.normal(0, 0.2))),
                gamma=gamma * float(np.exp(rng.normal(0, 0.02 * differ))),
                black=black + float(rng.normal(0, 1.5 * differ)),
                contrast=contrast * float(np.exp(rng.normal(0, 0.02 * differ))),
                quality=quality,
            )
        )
    return pair[0], pair[1]


def _weights(deviation: float) -> NDArray[np.float64]:
    reach = max(1, int(np.ceil(3 * deviation)))
    w = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(deviation, 1e-3)) ** 2)
    return np.asarray(w / w.sum())


@njit(cache=True, nogil=True, error_model="numpy")
def _blurred(image: Any, w: Any) -> Any:
    """Return the image (h, w) float64 after a separable filter; the border is repeated."""
    rows, columns = image.shape
    reach = w.size // 2
    out = np.zeros((rows, columns))
    padded = np.empty(columns + 2 * reach)
    across = np.zeros((rows, columns))
    for r in range(rows):
        padded[:reach] = image[r, 0]
        padded[reach : reach + columns] = image[r]
        padded[reach + columns :] = image[r, columns - 1]
        line = across[r]
        for k in range(w.size):
            share = w[k]
            for c in range(columns):
                line[c] += share * padded[c + k]
    for r in range(rows):
        line = out[r]
        for k in range(w.size):
            source, share = across[min(max(r + k - reach, 0), rows - 1)], w[k]
            for c in range(columns):
                line[c] += share * source[c]
    return out


def blurred(image: NDArray[np.float64], deviation: float) -> NDArray[np.float64]:
    """Return the image after a Gaussian blur, samples; below 0.15 it is returned as it is."""
    return image if deviation < 0.15 else np.asarray(_blurred(image, _weights(deviation)))


def sensor_noise(image: NDArray[np.float64], shot: float, read: float, rng: Rng) -> NDArray[np.float64]:
    """Return light (H, W), range 0..1, with noise of variance ``shot * light + read**2``."""
    return np.asarray(image + np.sqrt(shot * np.maximum(image, 0) + read**2) * rng.standard_normal(image.shape))


def compressed(picture: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """Return a picture (H, W) or (H, W, 3) after JPEG compression."""
    stored = picture if picture.ndim == 2 else np.ascontiguousarray(picture[..., ::-1])
    _, coded = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if picture.ndim == 2:
        return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8)
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)[..., ::-1]


def _defocused(fine: NDArray[np.float64], spread: NDArray[np.float64], base: float) -> NDArray[np.float64]:
    """Return the image blurred by `base` and `spread` (of each sample) together, from four blurs mixed."""
    steps = base + np.array([0.0, 1.0, 2.5, 5.0])
    layers = [blurred(fine, float(step)) for step in steps]
    positions = np.clip(base + spread, steps[0], steps[-1])
    out = layers[0]
    for k in range(3):
        share = np.clip((positions - steps[k]) / (steps[k + 1] - steps[k]), 0, 1)
        mixed = (1 - share) * layers[k] + share * layers[k + 1]
        out = np.asarray(np.where(positions > steps[k], mixed, out), np.float64)
    return out


def expose(light: NDArray[np.float32], disparity: NDArray[np.float64], sensor: Sensor, rng: Rng) -> NDArray[np.uint8]:
    """Return the picture that a camera takes.

    Parameters
    ----------
    light : (2 * H, 2 * W) float32
        Four samples per pixel.
    disparity : (2 * H, 2 * W) float64
        Of the samples, for the defocus.
    sensor : Sensor
    rng : Generator
        Draws the noise.

    Returns
    -------
    (H, W) uint8
    """
    fine = np.minimum(light.astype(np.float64) * sensor.exposure, 4.0)  # a bright spot bleeds a little, not without end
    if sensor.defocus > 0:
        top = max(float(disparity.max()), 1e-6)
        spread = np.abs(disparity - sensor.focus * top) * sensor.defocus * min(2.0, 100 / top)
        fine = _defocused(fine, np.asarray(2 * spread), 2 * sensor.blur)
    else:
        fine = blurred(fine, 2 * sensor.blur)
    image = (fine[::2, ::2] + fine[1::2, ::2] + fine[::2, 1::2] + fine[1::2, 1::2]) / 4
    height, width = image.shape
    y, x = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)[None]
    image = np.minimum(image * (1 - sensor.vignette * (x * x + y * y) / 2), 1.0)
    image = sensor_noise(image, sensor.shot, sensor.read, rng)
    image = blurred(image, sensor.resample)
    # a table keeps the power, which processors round differently, away from each pixel
    steps = np.rint(255 * 16 * np.clip(image, 0, 1)).astype(np.int64)
    code = 255 * (np.arange(255 * 16 + 1) / (255 * 16)) ** sensor.gamma * sensor.contrast + sensor.black
    picture = np.clip(np.rint(code[steps]), 0, 255).astype(np.uint8)
    return compressed(picture, sensor.quality) if sensor.quality else picture
