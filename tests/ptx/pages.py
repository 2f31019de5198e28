"""The modelled tables of the documentation, made by the commands that stand above them.

``python -m ptx.pages`` in ``tests/`` prints them; with ``--write`` it puts them between their marks in ``docs/gpu.md``.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from stereokit.cli.app import app
from stereokit.defaults import METHODS
from stereokit_evaluation.gpu_model.machines import MACHINES

PAGE = Path(__file__).parents[2] / "docs" / "gpu.md"
_NAMES = [machine.name for machine in MACHINES]


def bench(*words: str) -> str:
    """Return the output of ``stereokit bench --model``."""
    done = CliRunner().invoke(app, ["bench", "--model", *words], catch_exceptions=False)
    if done.exit_code:
        raise SystemExit(done.output)
    return done.stdout


def launches() -> str:
    """Return the table of S4 at half size, as it is printed."""
    title, *lines = bench("--method", "S4", "--scale", "0.5").partition("bytes of costs")[0].rstrip().splitlines()
    return "\n".join(["```text", " " * 24 + title.strip(), *(line.rstrip() for line in lines), "```"])


def twice(match: dict[str, Any], machine: str) -> float:
    """Return the modelled milliseconds at twice the bounds."""
    times = [one["modelled_ms"][machine] for one in match["launches"]]
    return float(sum(2 * time["all"] - time["launch"] for time in times))


def methods() -> str:
    """Return the table of all methods at both sizes."""
    short = {name: key for key, name in METHODS.items()}
    heads = ["launches", "MB, modelled", "of libSGM's path volumes", *(f"{name}, modelled ms" for name in _NAMES)]
    rows = [["1242x375, 128 levels", *heads], ["---"] * (1 + len(heads))]
    for size, words in (("full", ()), ("half", ("--scale", "0.5"))):
        for match in json.loads(bench(*words, "--json", "-"))["modelled"]:
            ratio = match["bytes_of_libsgm"]
            times = (f"{match['modelled_ms'][name]:.2f} to {twice(match, name):.2f}" for name in _NAMES)
            shares = "-" if ratio is None else f"{ratio:.2f}"
            figures = str(len(match["launches"])), f"{match['bytes'] / 1e6:.1f}", shares
            rows.append([f"{short[match['method']]} {size}", *figures, *times])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def main(write: bool) -> None:
    """Print the tables; with `write`, put them into the page."""
    text = PAGE.read_text(encoding="utf-8")
    for name, make in (("launches", launches), ("methods", methods)):
        table = make()
        print(table, end="\n\n")
        begin, end = f"<!-- modelled {name} -->\n", "\n<!-- end -->"
        text, count = re.subn(f"(?s)(?<={begin}).*?(?={end})", lambda _: table, text)  # noqa: B023 (called at once)
        if count != 1:
            raise SystemExit(f"{PAGE.name} must have the mark {begin.strip()!r} once, found it {count} times")
    if write:
        PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main("--write" in sys.argv[1:])
