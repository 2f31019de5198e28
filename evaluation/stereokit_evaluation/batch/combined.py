"""A folder of files that hold both views of a pair each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from stereokit.errors import FileError, StereokitError
from stereokit.io import READABLE_SUFFIXES, read_views
from stereokit_evaluation.batch.video import FramePair, Frames

__all__ = ["CombinedFiles"]

_SUFFIXES = (*READABLE_SUFFIXES, ".mpo", ".jps", ".pns")


class CombinedFiles(Frames):
    """The pairs of files with both views; each is named like its file, without the suffix.

    Parameters
    ----------
    folder : Path
        All images in it count.
    layout : str
        Where the views are; see `stereokit.io.read_views`.

    Raises
    ------
    FileError
        If there are no images, or two would have one name.
    """

    def __init__(self, folder: Path, layout: str) -> None:
        self.layout = layout
        self.paths: dict[str, Path] = {}
        for path in sorted(p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES and p.is_file()):
            if path.stem in self.paths:
                raise FileError(f"two files of one name in {str(folder)!r}: {self.paths[path.stem].name}, {path.name}")
            self.paths[path.stem] = path
        if not self.paths:
            raise FileError(f"no images with two views in {str(folder)!r}")
        self.expected = len(self.paths)

    def frames(self, wanted: Callable[[str], bool] = lambda name: True) -> Iterator[FramePair]:
        """Yield the pairs whose names are wanted, by name."""
        for name, path in self.paths.items():
            if wanted(name):
                try:
                    yield FramePair(name, *read_views(path, self.layout))
                except StereokitError as error:
                    yield FramePair(name, None, None, str(error))

    def owns(self, name: str) -> bool:
        """Return whether a file has this name."""
        return name in self.paths
