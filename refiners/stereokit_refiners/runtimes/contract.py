"""What a runtime makes of a network."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Run"]


class Run(Protocol):
    """A network that is compiled for a size; safe to call from several threads at once."""

    def __call__(self, inputs: dict[str, NDArray[Any]], use: Callable[[NDArray[np.float32]], Any] = np.array) -> Any:
        """Return what `use` makes of the head.

        Parameters
        ----------
        inputs : dict of (C, h, w) arrays
            Encoded, by name.
        use : callable
            Is given the head, (h, w, C) float32, C-contiguous, which the next call may write over; the default copies
            it.
        """
