"""Data sets, the KITTI 2015 evaluator and its command: everything that measures stereokit.

Nothing is imported here, so that one part can be used without paying for the others.
"""

from __future__ import annotations

__all__: list[str] = []
