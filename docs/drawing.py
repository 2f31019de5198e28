"""What the build makes for the pages: pictures of the synthetic street, a chart, and the help of every command.

Nothing here is stored in the repository, so no picture can be of an older version than the text beside it.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import page_tables
import typer
from matplotlib.figure import Figure

from stereokit import Calibration, Matcher
from stereokit.cli.app import app
from stereokit.io import make_folder, write_bytes
from stereokit.result import Disparity, colorize
from stereokit_evaluation.commands.demo import Panel, overview
from stereokit_evaluation.scoring.error_map import error_map
from stereokit_evaluation.scoring.kitti import score
from stereokit_evaluation.synthetic.scenes import Scene, generate

BENCHMARKS = Path(__file__).with_name("benchmarks.md")
WIDTH, HEIGHT, LEVELS, TILE = 828, 250, 96, 414
FAR_M, STREETS = 50.0, 6


class Street:
    """The synthetic street of the pages, and maps of it."""

    def __init__(self) -> None:
        self.scene: Scene = generate(0, WIDTH, HEIGHT, LEVELS)
        self.high = float(self.scene.disparity.max())

    def match(self, method: str, **options: Any) -> Disparity:
        """Return a method's result."""
        return Matcher(method, max_disparity=LEVELS, **options)(self.scene.left, self.scene.right)

    def panel(self, name: str, result: Disparity) -> Panel:
        """Return a map and its errors as a row of a picture."""
        scored = score(result.disparity, noc=self.scene.noc, occ=self.scene.occ, measured=result.valid)
        wrong = error_map(result.disparity, self.scene.occ, self.scene.noc, dilate=False)
        return Panel(name, colorize(result.disparity, 0, self.high), wrong, scored.noc.all.filled.d1())

    def sheet(self, panels: list[Panel]) -> np.ndarray:
        """Return the rows under the left image and the true disparity."""
        return overview(self.scene.left, colorize(self.scene.disparity, 0, self.high), panels, tile_width=TILE)


def write_all(folder: Path) -> None:
    """Write everything into `folder`."""
    make_folder("folder", folder)
    write_bytes(folder / "commands.md", commands_help().encode())
    measured, refined_ones = (page_tables.find(BENCHMARKS, head) for head in ("MB added", "ms of S4, 1 / 2 threads"))
    write_bytes(folder / "measured.md", measured.text.encode())
    write_bytes(folder / "refined.md", refined_ones.text.encode())
    write_bytes(folder / "tradeoff.svg", page_tables.tradeoff(measured))
    street = Street()
    rows = [street.panel(name, street.match(name)) for name in ("S1", "S2", "S3", "S4")]
    rows += [street.panel(f"{m}/2+stereokit: half size, refined", refined(street, m)) for m in ("S2", "S4")]
    write_bytes(folder / "methods.jpg", jpeg(street.sheet(rows)))
    tuned = [street.panel(f"P2={p2}", street.match("S2", p1=min(15, p2), p2=p2)) for p2 in (5, 85, 200)]
    write_bytes(folder / "penalties.jpg", jpeg(street.sheet(tuned)))
    write_bytes(folder / "confidence.jpg", jpeg(measured_and_sure(street)))
    write_bytes(folder / "depth_error.svg", depth_error())
    write_bytes(folder / "memory.svg", memory())


def jpeg(picture: np.ndarray) -> bytes:
    """Return an RGB picture as a file of some 200 kB."""
    return cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()


def refined(street: Street, method: str) -> Disparity:
    """Return a method at half size, brought to full size by the project's own network."""
    return street.match(method, scale=0.5, refiner="stereokit")


def measured_and_sure(street: Street) -> np.ndarray:
    """Return the map with its gaps, where it was measured, and the confidence, side by side."""
    result = street.match("S2", fill=None, confidence=True)
    assert result.confidence is not None
    gray = [np.uint8(255) * result.valid.astype(np.uint8), np.rint(255 * result.confidence).astype(np.uint8)]
    pictures = [colorize(result.disparity, 0, street.high), *(cv2.cvtColor(g, cv2.COLOR_GRAY2RGB) for g in gray)]
    size = (TILE, round(TILE * HEIGHT / WIDTH))
    tiles = [cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures]
    gap = np.full((size[1], 6, 3), 255, np.uint8)
    return np.hstack([tiles[0], gap, tiles[1], gap, tiles[2]])


def depth_error() -> bytes:
    """Return a chart of depth errors by distance: by geometry, and of S2 on some streets."""
    truth, depths = [], []
    for seed in range(STREETS):
        scene = generate(seed)
        camera = Calibration(scene.focal_px, scene.focal_px, scene.cx, scene.cy, scene.baseline_m)
        result = Matcher("S2")(scene.left, scene.right)
        known = result.valid & np.isfinite(scene.noc)
        truth.append(camera.disparity_to_depth(scene.noc)[known])
        depths.append(result.depth(camera)[known])
    distance, error = np.concatenate(truth), np.abs(np.concatenate(depths) - np.concatenate(truth))
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.add_subplot()
    z = np.linspace(4, FAR_M, 200)
    for pixels in (0.1, 0.25, 0.5, 1.0):
        grown = z**2 * pixels / (camera.fx * camera.baseline_m)
        axes.plot(z, grown, color="0.6", linewidth=1)
        axes.text(FAR_M + 0.5, grown[-1], f"{pixels:g} px", color="0.4", va="center", fontsize=9)
    steps = np.arange(5, FAR_M, 5)
    middle = [np.nanmedian(error[np.abs(distance - step) < 2.5]) for step in steps]
    axes.plot(steps, middle, "o-", color="tab:red", label=f"median error of S2 on {STREETS} synthetic streets")
    axes.set(xlabel="distance, m", ylabel="depth error, m", yscale="log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.legend(frameon=False, loc="upper left")
    return svg(figure, axes)


def memory() -> bytes:
    """Return a chart of the buffers of S2 by the size of the image, as the library measures them."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.add_subplot()
    rows = np.linspace(300, 3000, 40)
    megapixels = rows * rows * 4 / 3 / 1e6
    for levels, color in ((128, "tab:green"), (256, "tab:blue"), (512, "tab:red")):
        for search, style in (("full", "--"), ("coarse-to-fine", "-")):
            matcher = Matcher("S2", max_disparity=levels, search=search, threads=1)
            megabytes = [matcher.nbytes(round(y), round(4 / 3 * y)) / 1e6 for y in rows]
            axes.plot(megapixels, megabytes, style, color=color)
            if search == "full":
                axes.text(megapixels[-1] + 0.1, megabytes[-1], f"{levels} levels, full", va="center", fontsize=9)
    axes.text(megapixels[-1] + 0.1, 0.9 * megabytes[-1], "all, coarse-to-fine", va="top", fontsize=9)
    axes.set(xlabel="megapixels", ylabel="MB of buffers, S2, one thread", xlim=(0, 12), ylim=(0, None))
    return svg(figure, axes)


def svg(figure: Figure, axes: Any) -> bytes:
    """Return a chart as a file."""
    axes.spines[["top", "right"]].set_visible(False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def commands_help() -> str:
    """Return the help of every command, as Markdown."""
    group = typer.main.get_command(app)
    parts = []
    with typer.main.get_command(app).make_context("stereokit", ["list"]) as context:
        for name in group.list_commands(context):
            command = group.get_command(context, name)
            own = typer.Context(command, info_name=name, parent=context, terminal_width=88)
            parts.append(f"## {name}\n\n```text\n{command.get_help(own)}\n```\n")
    return "\n".join(parts)
