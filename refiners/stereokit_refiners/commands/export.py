"""The command ``stereokit export``: a learned refiner as a file for other runtimes, checked before it is written.

The exported graph is the whole refiner, with scaling and upsampling inside:

- ``coarse``, (1, 1, h, w) float32: half-size map in half-size pixels, without gaps, from 0 on (lift a range that begins
  below to 0, and lower the result by twice as much); h and w multiples of the network's own (4 or 8);
- ``left``, (1, 1, 2h, 2w) float32: grey levels 0 to 255;
- ``confidence``, (1, 1, h, w) float32, 0 to 1, 0 where not measured, for networks that look at it;
- ``candidates``, (1, 2, h, w) float32, the matcher's, half-size pixels, for networks that look at them;
- result ``disparity``, (1, 1, 2h, 2w) float32, full-size pixels.

ONNX leaves h and w open. OpenVINO's IR is made from the same graph (opset 18).
"""

from __future__ import annotations

import importlib.util
import os
import secrets
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from stereokit.cli.options import JsonOption, WeightsOption, check_json, write_json
from stereokit.errors import FileError, OptionError, StereokitError
from stereokit.io import write_bytes
from stereokit.result import Disparity
from stereokit_refiners.learned import LearnedRefiner
from stereokit_refiners.weights import NETWORKS, WeightFile, find, read

__all__ = ["TOLERANCE_PX", "export", "largest_difference", "onnx_model"]

TOLERANCE_PX = 0.01
"""How far an exported graph may be from the refiner, by rounding."""

_FORMATS = ("onnx", "openvino")


def export(
    output: Annotated[Path, typer.Option("--output", "-o", help="FILE.onnx, or FILE.xml with FILE.bin beside it.")],
    refiner: Annotated[str, typer.Option(help="stereovae, cnn, pyramid, or a weight file.")] = "stereovae",
    weights: WeightsOption = None,
    format: Annotated[str, typer.Option(help="onnx or openvino.")] = "onnx",
    json_file: JsonOption = None,
) -> None:
    """Write a learned refiner as ONNX or OpenVINO IR, after comparing it with the refiner itself."""
    check_json(json_file)
    if format not in _FORMATS:
        raise OptionError(f"format must be one of {', '.join(_FORMATS)}, got {format!r}")
    ending = {"onnx": ".onnx", "openvino": ".xml"}[format]
    if output.suffix.lower() != ending:
        raise OptionError(f"output must end in {ending} for format {format!r}, got {str(output)!r}")
    if output.is_dir() or not output.parent.is_dir():
        raise FileError(f"output must name a file in an existing folder, got {str(output)!r}")
    content = _content(refiner, weights)
    _check_exportable(content)
    needed = ["onnxruntime"] + (["openvino"] if format == "openvino" else [])
    for module in needed:
        if importlib.util.find_spec(module) is None:
            raise StereokitError(
                f"export needs {module}, which is not installed: pip install 'stereokit[onnx,refiners]'"
            )
    model = onnx_model(content)
    difference = largest_difference(content, model)
    if not difference <= TOLERANCE_PX:
        raise StereokitError(
            f"the exported graph differs from the refiner by {difference:.3g} pixels; nothing was written"
        )
    if format == "onnx":
        write_bytes(output, model)
    else:
        _write_openvino(model, output)
    document = {
        "output": str(output), "format": format, "network": content.network, "output_mode": content.output_mode,
        "weights": content.fingerprint, "largest_difference_px": difference,
    }  # fmt: skip
    if not write_json(json_file, document):
        typer.echo(f"wrote {output} ({content.network}); largest difference {difference:.2g} pixels")


def _content(refiner: str, weights: str | None) -> WeightFile:
    if refiner.endswith(".safetensors"):
        if weights is not None:
            raise OptionError(f"weights must not be given with a weight file, got {weights!r} and {refiner!r}")
        return read(refiner)
    network = {"general": "evidence", "stereokit": "evidence"}.get(refiner, refiner)
    if network not in NETWORKS:
        raise OptionError(
            f"refiner to export must be one of {', '.join(NETWORKS)} or a .safetensors file, got {refiner!r}"
        )
    return find(network, weights)


def _check_exportable(content: WeightFile) -> None:
    """Raise OptionError for the network whose input compiled loops make of both images."""
    if NETWORKS[content.network].outputs[content.output_mode] is None:
        raise OptionError(
            f"refiner to export must be one whose input is the coarse map and the left image, got {content.network!r}: "
            "its evidence, matching costs of both images, is computed by compiled loops, for which ONNX has no nodes"
        )


def onnx_model(content: WeightFile) -> bytes:
    """Return the refiner of a weight file as a serialised ONNX model."""
    from stereokit_refiners.runtimes.onnx import map_graph

    return map_graph(NETWORKS[content.network], content.arrays, content.output_mode)


def largest_difference(content: WeightFile, model: bytes) -> float:
    """Return the largest difference, full-size pixels, of an ONNX model from the refiner on a textured ramp."""
    import onnxruntime

    rng = np.random.default_rng(0)
    rows, columns = 48, 80
    coarse = np.tile(np.linspace(2, 40, columns, dtype=np.float32), (rows, 1))
    coarse[16:32, 20:50] += 8
    confidence = np.maximum(rng.random((rows, columns), np.float32) - np.float32(0.1), np.float32(0))
    left = rng.integers(0, 256, (2 * rows, 2 * columns), dtype=np.uint8)
    candidates = np.stack([coarse, coarse[:, ::-1]]) + rng.random((2, rows, columns), np.float32)  # the rival is far
    refined = _reference(content, Disparity(coarse, confidence > 0, confidence, candidates=candidates), left)
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    feeds = {"coarse": coarse, "confidence": confidence, "candidates": candidates, "left": left.astype(np.float32)}
    inputs = {i.name: feeds[i.name].reshape(1, -1, *feeds[i.name].shape[-2:]) for i in session.get_inputs()}
    return float(np.abs(session.run(None, inputs)[0][0, 0] - refined).max())


def _reference(content: WeightFile, coarse: Disparity, left: NDArray[np.uint8]) -> NDArray[np.float32]:
    refiner = LearnedRefiner.of(content, backend="auto", precision="fp32")
    candidates = coarse.candidates if refiner.needs_candidates else None
    return refiner.network_map(coarse.disparity, candidates, coarse.confidence, left)


def _write_openvino(model: bytes, output: Path) -> None:
    """Write FILE.xml and FILE.bin; the second first, so that an .xml that is there is whole."""
    import openvino as ov

    graph: Any = ov.Core().read_model(model=model, weights=b"")
    token = output.with_name(f".{secrets.token_hex(8)}.xml")
    try:
        ov.save_model(graph, str(token), compress_to_fp16=False)
        os.replace(token.with_suffix(".bin"), output.with_suffix(".bin"))
        os.replace(token, output)
    except OSError as error:
        raise FileError(f"cannot write {str(output)!r}: {error.strerror or error}") from error
    finally:
        token.unlink(missing_ok=True)
        token.with_suffix(".bin").unlink(missing_ok=True)
