"""Versions of the packages that results depend on, for reports."""

from __future__ import annotations

import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version

import cv2

__all__ = ["versions"]


def versions(others: Iterable[str] = ()) -> dict[str, str | None]:
    """Return the versions of this package and of those that it computes with, and of `others` that are installed."""
    core: dict[str, str | None] = {name: _version(name) for name in ("stereokit", "numba", "numpy")}
    core |= {"opencv": cv2.__version__, "python": platform.python_version()}
    return core | {name: _version(name) for name in sorted(others) if _version(name)}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
