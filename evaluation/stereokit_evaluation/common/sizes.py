"""The sizes and numbers of threads of the command ``bench``."""

from __future__ import annotations

import re
from dataclasses import dataclass

from stereokit.errors import OptionError

__all__ = ["SIZES", "Size", "parse_sizes", "parse_threads"]

_MAX_LEVELS = 2048


@dataclass(frozen=True)
class Size:
    """A problem: `width` x `height` pixels, disparities 0 to `levels` - 1."""

    name: str
    width: int
    height: int
    levels: int

    @property
    def cells(self) -> int:
        """Pixels times levels."""
        return self.width * self.height * self.levels


SIZES = {size.name: size for size in (Size("K", 1242, 375, 128), Size("M", 1342, 1110, 256), Size("H", 621, 188, 64))}
"""KITTI, Middlebury at half size, and KITTI at half size."""


def parse_sizes(text: str) -> list[Size]:
    """Return the sizes named in `text`, such as ``"K,640x480x64"``, each once.

    Raises
    ------
    OptionError
        If one is neither known nor ``WxHxD``, or has no more columns than levels.
    """
    sizes: list[Size] = []
    for word in (part.strip() for part in text.split(",")):
        numbers = re.fullmatch(r"(\d{1,6})x(\d{1,6})x(\d{1,6})", word.lower())
        if word.upper() in SIZES:
            size = SIZES[word.upper()]
        elif numbers:
            width, height, levels = (int(number) for number in numbers.groups())
            size = Size(f"{width}x{height}x{levels}", width, height, levels)
            if height < 1 or not 2 <= levels <= _MAX_LEVELS or width <= levels:
                raise OptionError(
                    f"sizes must be WxHxD with H of 1 or more, D from 2 to {_MAX_LEVELS} and W above D, got {word!r}"
                )
        else:
            raise OptionError(f"sizes must be K, M, H or WxHxD such as 640x480x64, with commas, got {word!r}")
        sizes.append(size)
    return list(dict.fromkeys(sizes))


def parse_threads(text: str, name: str = "threads") -> list[int]:
    """Return the numbers in `text`, such as ``"1,2"``, each once; `name` is what messages call it.

    Raises
    ------
    OptionError
        If one is no whole number from 1 to 1024.
    """
    words = [word.strip() for word in text.split(",")]
    if not all(re.fullmatch(r"[0-9]{1,4}", word) and 1 <= int(word) <= 1024 for word in words):
        raise OptionError(f"{name} must be whole numbers from 1 to 1024, with commas, got {text!r}")
    return list(dict.fromkeys(int(word) for word in words))
