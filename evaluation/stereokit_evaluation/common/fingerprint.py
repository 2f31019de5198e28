"""Digests of source files, for the names of what they made: a file of older code is then never taken for a new one."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

__all__ = ["fingerprint"]


def fingerprint(sources: Iterable[Path]) -> str:
    """Return a digest of files' contents, in the order given, 12 letters."""
    digest = hashlib.sha256()
    for path in sources:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]
