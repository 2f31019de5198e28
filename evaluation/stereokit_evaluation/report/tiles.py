"""Pairs of a report in files of their own, beside the page: a browser reads them when they are looked at.

A page opened from a disk may not fetch files, but it may load scripts: so a tile is a script that hands its JSON to
``Tiles.put`` (``assets/viewer.js``). A pair has one tile for its images and truth, and one for each map.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from urllib.parse import quote

from stereokit.io import write_bytes
from stereokit_evaluation.common.folders import make_folder

__all__ = ["TileFolder", "json_text"]


class TileFolder:
    """The folder ``NAME_files`` beside the page ``NAME.html``.

    Parameters
    ----------
    page : Path
        The page; the folder is created at the first pair.
    """

    def __init__(self, page: Path) -> None:
        self.folder = page.with_name(f"{page.stem}_files")
        self.bytes = 0
        self._count = 0

    def add(self, pair: dict[str, Any]) -> dict[str, Any]:
        """Write a pair, and return what the page itself needs of it.

        Parameters
        ----------
        pair : dict
            Result of `stereokit_evaluation.report.viewer.pair`.

        Returns
        -------
        dict
            Its ``name``, number of ``maps``, whether it has a ``calibration``, and its ``tile``, the path of its
            script from the page.

        Raises
        ------
        FileError
            If a file cannot be written.
        """
        make_folder(self.folder, "report")
        number, self._count = self._count, self._count + 1
        maps = []
        for index, entry in enumerate(pair["maps"]):
            tile = self._write(f"pair-{number}-map-{index}", {name: entry[name] for name in ("map", "measured")})
            maps.append({"name": entry["name"], "note": entry["note"], "tile": tile})
        tile = self._write(f"pair-{number}", {**pair, "maps": maps})
        return {"name": pair["name"], "maps": maps, "calibration": pair["calibration"], "tile": tile}

    def _write(self, name: str, content: dict[str, Any]) -> str:
        tile = f"{quote(self.folder.name)}/{name}.js"
        data = f"Tiles.put({json_text(tile)}, {json_text(content)});\n".encode()
        write_bytes(self.folder / f"{name}.js", data)
        self.bytes += len(data)
        return tile


def json_text(value: Any) -> str:
    """Return JSON that may stand inside a script element, and is a JavaScript literal."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
