"""YAML, XML and JSON, among them OpenCV's dialects, as one tree of plain values; the files may hold anything.

OpenCV's own reader is not used: its C++ is not made for hostile files. Sources: the documentation of `cv::FileStorage`
(OpenCV's tutorial "File Input and Output using XML, YAML and JSON files"); YAML 1.1.
"""

from __future__ import annotations

import json
import re
from typing import Any
from xml.etree import ElementTree

import yaml

from stereokit.errors import OptionError, one_line

__all__ = ["from_json", "from_xml", "from_yaml", "is_matrix", "leaves"]

_MOST_LEAVES = 20_000
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Tags(_Loader):  # type: ignore[misc]
    """A safe loader to which tags, such as OpenCV's ``!!opencv-matrix``, say nothing."""


def _untagged(loader: Any, suffix: str, node: Any) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_scalar(node)


_Tags.add_multi_constructor("", _untagged)
_Tags.add_multi_constructor("tag:", _untagged)
_Tags.add_multi_constructor("!", _untagged)


def from_yaml(text: str) -> Any:
    """Return the first document of a YAML file that says anything.

    Raises
    ------
    OptionError
        If it is no YAML.
    """
    plain = re.sub(r"\A\s*%YAML[: ][^\n]*\n", "", text)  # "%YAML:1.0", as OpenCV has it, is none
    plain = plain.replace("\t", " ")
    if re.search(r"<<\s*:", plain):  # a few lines of these can stand for more than any memory holds
        raise OptionError("not a calibration: it has YAML's merge keys, <<")
    try:
        for document in yaml.load_all(plain, Loader=_Tags):
            if document is not None:
                return document
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f", line {mark.line + 1}"
        problem = getattr(error, "problem", None) or str(error)
        raise OptionError(f"not valid YAML{where}: {one_line(str(problem))}") from error
    return None


def from_json(text: str) -> Any:
    """Return what a JSON file says.

    Raises
    ------
    OptionError
        If it is no JSON.
    """
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise OptionError(f"not valid JSON, line {error.lineno}: {error.msg}") from error


def from_xml(text: str) -> Any:
    """Return what an XML file of OpenCV says: mappings, and text divided by blanks.

    Raises
    ------
    OptionError
        If it is no XML, or has a document type of its own, which OpenCV never writes.
    """
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise OptionError("not an OpenCV file: it has a document type of its own")
    try:
        root = ElementTree.fromstring(text.strip())
    except ElementTree.ParseError as error:
        raise OptionError(f"not valid XML, {one_line(str(error))}") from error
    return _element(root, 0)


def _element(element: ElementTree.Element, depth: int) -> Any:
    if depth > 50:
        raise OptionError("it is nested too deeply")
    children = list(element)
    if children and all(child.tag == "_" for child in children):
        return [_element(child, depth + 1) for child in children]
    if children:
        return {child.tag: _element(child, depth + 1) for child in children}
    words = (element.text or "").replace('"', " ").split()
    return words[0] if len(words) == 1 else words


def is_matrix(value: Any) -> bool:
    """Return whether a value is a matrix as OpenCV and ROS write it: rows, cols and data."""
    return isinstance(value, dict) and "data" in value and isinstance(value["data"], list | str | int | float)


def leaves(tree: Any) -> dict[str, Any]:
    """Return all values of a tree by their paths, in lower case without ``_``, ``-`` and the like.

    Matrices and lists of plain values are values.

    Raises
    ------
    OptionError
        If there are more than a calibration has.
    """
    values: dict[str, Any] = {}
    waiting: list[tuple[str, Any, int]] = [("", tree, 0)]
    steps = 0
    while waiting:
        path, value, depth = waiting.pop()
        steps += 1
        if steps > _MOST_LEAVES or depth > 50:
            raise OptionError("it holds more than a calibration does")
        if is_matrix(value):
            values[path] = value["data"]
        elif isinstance(value, dict):
            waiting += [(path + plain_name(key), part, depth + 1) for key, part in value.items()]
        elif value is not None:
            values[path] = value
    return values


def plain_name(name: Any) -> str:
    """Return a name as it is compared: lower case letters and digits."""
    return "".join(c for c in str(name).lower() if c.isalnum())
