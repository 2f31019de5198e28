"""Digests of source files, for the names of cached files: a file of older code is then never taken for a new one."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

__all__ = ["fingerprint"]


def fingerprint(sources: Iterable[Path]) -> str:
    """Return a digest of the contents of files, in their order, 12 hexadecimal digits."""
    digest = hashlib.sha256()
    for path in sources:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]
