"""The command ``stereokit warmup``: kernels compiled ahead, as in the build of a container."""

from __future__ import annotations

import time
from typing import Annotated, Any

import typer

from stereokit.cli.options import MaxDisparityOption, RefinerOption, ScaleOption
from stereokit.cli.output import waiting

__all__ = ["warmup"]


def warmup(
    methods: Annotated[list[str] | None, typer.Argument(metavar="[METHOD]...", help="S1 to S4; all of them.")] = None,
    max_disparity: MaxDisparityOption = 128,
    scale: ScaleOption = 1.0,
    refiner: RefinerOption = None,
) -> None:
    """Compile the kernels of methods, or load them, so that no later command waits for it.

    Give the options that will be used. NUMBA_CACHE_DIR names the folder of compiled kernels; without it they lie beside
    the source.
    """
    from stereokit.defaults import METHODS
    from stereokit.matching import Matcher
    from stereokit.matching import warmup as compile_kernels

    options: dict[str, Any] = {"max_disparity": max_disparity, "scale": scale, "refiner": refiner}
    names = methods or list(METHODS)
    for name in names:
        Matcher(name, **options)  # refuses what cannot be, before anything is compiled
    for name in names:
        start = time.perf_counter()
        with waiting(f"compiling {name}"):
            compile_kernels(name, **options)
        typer.echo(f"{name}: {time.perf_counter() - start:.1f} s")
