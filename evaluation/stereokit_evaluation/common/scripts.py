"""How a script of ``python -m`` ends: as the commands of ``stereokit`` do."""

from __future__ import annotations

import sys
from collections.abc import Callable

from stereokit.errors import StereokitError

__all__ = ["exit_status"]


def exit_status(run: Callable[[], object]) -> int:
    """Run a script and return its exit status: 2 after one line about a mistake of the user, 130 after an interrupt."""
    try:
        run()
    except StereokitError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0
