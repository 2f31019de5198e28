"""ONNX files, written without the package onnx: the few messages of its format that graphs of networks need.

The base package must make graphs for OpenCV, and may bring nothing that it does not need otherwise. Field numbers are
those of ``onnx.proto`` (IR version 9); the tests read what is written here with the package onnx and have it checked.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Node", "model_bytes"]

_IR_VERSION, _OPSET = 9, 18
_ELEMENTS = {"float32": 1, "int64": 7}  # TensorProto.DataType
_VARINT, _BYTES, _FIXED_32 = 0, 2, 5  # wire types


@dataclass(frozen=True)
class Node:
    """One operation.

    Parameters
    ----------
    kind : str
        Name of the operator.
    inputs, outputs : sequence of str
        Names of tensors.
    attributes : mapping
        Whole numbers, floats, strings, and sequences of whole numbers.
    """

    kind: str
    inputs: Sequence[str]
    outputs: Sequence[str]
    attributes: Mapping[str, Any]


def model_bytes(
    nodes: Sequence[Node], constants: Mapping[str, NDArray[Any]], inputs: Mapping[str, Sequence[int | str | None]],
    outputs: Mapping[str, Sequence[int | str | None]],
) -> bytes:  # fmt: skip
    """Return a model as the content of a file.

    Parameters
    ----------
    nodes : sequence of Node
        In the order in which they run.
    constants : mapping of float32 or int64 arrays
    inputs, outputs : mapping
        Shapes of float32 tensors by name; a side is a number, a name, or None where it is open.
    """
    graph = b"".join(_message(1, _node(node)) for node in nodes) + _text(2, "stereokit")
    graph += b"".join(_message(5, _tensor(name, array)) for name, array in constants.items())
    graph += b"".join(_message(11, _value(name, sides)) for name, sides in inputs.items())
    graph += b"".join(_message(12, _value(name, sides)) for name, sides in outputs.items())
    opset = _text(1, "") + _whole(2, _OPSET)
    return _whole(1, _IR_VERSION) + _text(2, "stereokit") + _message(7, graph) + _message(8, opset)


def _varint(value: int) -> bytes:
    value &= 2**64 - 1  # negative numbers as two's complement
    parts = bytearray()
    while value > 127:
        parts.append(value & 127 | 128)
        value >>= 7
    parts.append(value)
    return bytes(parts)


def _key(field: int, wire: int) -> bytes:
    return _varint(field << 3 | wire)


def _whole(field: int, value: int) -> bytes:
    return _key(field, _VARINT) + _varint(int(value))


def _message(field: int, content: bytes) -> bytes:
    return _key(field, _BYTES) + _varint(len(content)) + content


def _text(field: int, text: str) -> bytes:
    return _message(field, text.encode())


def _node(node: Node) -> bytes:
    names = b"".join(_text(1, name) for name in node.inputs) + b"".join(_text(2, name) for name in node.outputs)
    return names + _text(4, node.kind) + b"".join(_message(5, _attribute(*item)) for item in node.attributes.items())


def _attribute(name: str, value: Any) -> bytes:
    if isinstance(value, str):
        content, kind = _text(4, value), 3
    elif isinstance(value, float):
        content, kind = _key(2, _FIXED_32) + struct.pack("<f", value), 1
    elif isinstance(value, Sequence):
        content, kind = b"".join(_whole(8, each) for each in value), 7
    else:
        content, kind = _whole(3, value), 2
    return _text(1, name) + content + _whole(20, kind)


def _tensor(name: str, array: NDArray[Any]) -> bytes:
    dims = b"".join(_whole(1, side) for side in array.shape)
    content = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
    return dims + _whole(2, _ELEMENTS[array.dtype.name]) + _text(8, name) + _message(9, content)


def _value(name: str, sides: Sequence[int | str | None]) -> bytes:
    shape = b"".join(_message(1, _side(side)) for side in sides)
    return _text(1, name) + _message(2, _message(1, _whole(1, 1) + _message(2, shape)))


def _side(side: int | str | None) -> bytes:
    if side is None:
        return b""
    return _text(2, side) if isinstance(side, str) else _whole(1, side)
