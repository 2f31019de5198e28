"""The figures that the StereoVAE paper printed, each with the place where it stands. Nothing here was measured by us.

Source: Chang, Li, Xu, Liu, Li and Miyazaki, "StereoVAE: A lightweight stereo-matching system using embedded GPUs",
ICRA 2023. The paper numbers its figures; "fig. e4" and "fig. e5" are the labels of the two bar charts of its section
"Robustness", over the 40 validation images and over the test server's 200 images of KITTI 2015.

What to know before comparing:

* The paper does not say whether fig. e4 counts all pixels or only those that both cameras see. Fig. e5 is the "Noc"
  column: its S4 with StereoVAE, 4.73, is the "Noc/All" of table III, while the headline 5.24 is "All/All".
* Fig. 1 mixes the two columns: RTSMNet, GPUBNN and ReS2tAC stand there with "Noc", the others with "All" pixels. Its
  AnyNet (9.7 %, 16.58 ms) is another operating point than the one of table III (7.59 %, 26 fps).
* Table II gives StereoVAE 29.88 ms on the AGX, fig. 1 gives 32.5 ms. The table does not say at which size ZNCC+SGM
  ran, nor whether the times of the networks contain the matcher's.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = [
    "FIGURE_1",
    "PAPER",
    "TABLE_2",
    "TABLE_3",
    "TEST",
    "TEST_FRAMES",
    "TRAINING_FRAMES",
    "VALIDATION",
    "VALIDATION_FRAMES",
    "Point",
    "System",
    "agx_ms",
]

PAPER = "Chang et al., StereoVAE, ICRA 2023"

TRAINING_FRAMES, VALIDATION_FRAMES, TEST_FRAMES = 160, 40, 200
"""Section "Preparation": KITTI 2015's 200 training images, split; and its 200 test images."""

VALIDATION: dict[str, dict[str, float]] = {
    "S1": {"linear": 17.6, "original": 13.2, "stereovae": 11.78},
    "S2": {"linear": 9.73, "original": 7.09, "stereovae": 4.57},
    "S3": {"linear": 10.95, "original": 8.8, "stereovae": 7.56},
    "S4": {"linear": 9.56, "original": 6.4, "stereovae": 4.64},
}
"""Fig. e4, error rate in percent by matcher and setting: KITTI 2015 validation images; the pixels are not named."""

TEST: dict[str, dict[str, float]] = {
    "S1": {"linear": 23.8, "original": 14.5, "stereovae": 8.68},
    "S2": {"linear": 8.52, "original": 7.03, "stereovae": 5.41},
    "S3": {"linear": 10.35, "original": 8.26, "stereovae": 6.43},
    "S4": {"linear": 7.47, "original": 6.24, "stereovae": 4.73},
}
"""Fig. e5, error rate in percent by matcher and setting: KITTI 2015 test images, not occluded pixels."""

TABLE_2: dict[str, dict[str, float]] = {
    "ZNCC+SGM": {"TX2": 35.71, "AGX": 12.64},
    "Non-VAE NN": {"TX2": 72.1, "AGX": 27.9},
    "StereoVAE": {"TX2": 84.18, "AGX": 29.88},
}
"""Table II, milliseconds on a Jetson TX2 and on a Jetson AGX Xavier."""


@dataclass(frozen=True)
class System:
    """A row of table III: KITTI 2015 test server, percent; None where the paper has a dash.

    Attributes
    ----------
    bg, fg, all : pair of float or None
        D1 error of background, foreground and all pixels: "All/All" (with occluded ones), then "Noc/All".
    gpu : str
        The Jetson that it ran on.
    fps : float
        Frames a second.
    """

    name: str
    bg: tuple[float | None, float | None]
    fg: tuple[float | None, float | None]
    all: tuple[float | None, float | None]
    gpu: str
    fps: float


TABLE_3 = (
    System("StereoNet", (4.3, None), (7.45, None), (4.83, None), "TX2", 1),
    System("MADNet", (3.75, 3.45), (9.20, 8.41), (4.66, 4.27), "TX2", 4),
    System("RTS2Net", (3.09, None), (5.91, None), (3.56, None), "TX2", 6),
    System("RTSMNet", (3.44, 3.21), (6.08, 5.39), (3.88, 3.57), "AGX", 11),
    System("GPUBNN", (None, 3.5), (None, None), (None, 4.57), "AGX", 10),
    System("ReS2tAC", (6.27, 5.14), (16.07, 14.29), (7.9, 6.65), "AGX", 15),
    System("DWARF", (3.2, 2.95), (3.94, 3.66), (3.33, 3.07), "TX2", 1),
    System("AnyNet", (6.32, 6.01), (13.93, 13.11), (7.59, 7.18), "AGX", 26),
    System("StereoDNN", (2.7, 2.1), (6.0, 4.5), (3.2, 2.5), "TX2", 1),
    System("StereoVAE", (4.71, 4.38), (7.88, 6.48), (5.24, 4.73), "AGX", 30),
)
"""Table III."""


@dataclass(frozen=True)
class Point:
    """A published accuracy and time.

    Attributes
    ----------
    d1 : float
        D1 error on the KITTI 2015 test server, percent.
    ms : float
        Milliseconds on a Jetson AGX Xavier.
    pixels : str
        ``"occ"`` (all) or ``"noc"``, or ``""`` if no source names them.
    source : str
        The figure or page.
    """

    name: str
    d1: float
    ms: float
    pixels: str
    source: str


FIGURE_1 = (
    Point("AnyNet", 9.7, 16.58, "", "fig. 1"),
    Point("RTSMNet", 3.57, 87.7, "noc", "fig. 1"),
    Point("GPUBNN", 4.57, 100.0, "noc", "fig. 1"),
    Point("ReS2tAC", 6.65, 66.0, "noc", "fig. 1"),
    Point("SGM on a GPU", 8.24, 8.93, "", "fig. 1"),
    Point("Z2-ZNCC", 7.73, 12.64, "", "fig. 1"),
    Point("StereoVAE", 5.24, 32.5, "occ", "fig. 1"),
    Point("TinyStereo", 5.17, 1000 / 51, "", "its authors' repository: 51 fps"),
)
"""Fig. 1, and the network that its authors published later."""

_AGX = {("S4", "original"): "ZNCC+SGM", ("S4", "cnn"): "Non-VAE NN", ("S4", "stereovae"): "StereoVAE"}


def agx_ms(method: str, variant: str) -> float | None:
    """Return table II's milliseconds on the AGX for the same configuration as one of ours, None if it has none.

    Parameters
    ----------
    method : str
        ``"S1"`` to ``"S4"``.
    variant : str
        ``"linear"``, ``"original"``, ``"cnn"`` or ``"stereovae"``.
    """
    row = _AGX.get((method, variant))
    return None if row is None else TABLE_2[row]["AGX"]
