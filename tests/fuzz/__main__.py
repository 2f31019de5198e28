"""The command: so many calls and files, or as many as there is time for."""

from __future__ import annotations

import argparse
import faulthandler
import os
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterable
from itertools import count as numbers_from
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[2]
os.environ.setdefault("NUMBA_CACHE_DIR", str(ROOT / ".numba_cache"))

from fuzz.calls import run_call  # noqa: E402
from fuzz.files import run_file  # noqa: E402

CASE_SECONDS = 300
"""After which a case counts as one that never ends; the first of a kind compiles."""


class Watch:
    """Ends the process when a case does not end."""

    def __init__(self) -> None:
        self._case = ""
        self._begun = time.monotonic()
        threading.Thread(
            target=self._look, name="stereokit-watch", daemon=True
        ).start()  # the name keeps decoders quiet

    def begin(self, case: str) -> None:
        """Start the clock of a case."""
        self._case, self._begun = case, time.monotonic()

    def _look(self) -> None:
        while True:
            time.sleep(1)
            if time.monotonic() - self._begun > CASE_SECONDS:
                print(f"finding: no end after {CASE_SECONDS} s\n  repeat: {self._case}", flush=True)
                faulthandler.dump_traceback(all_threads=True)
                os._exit(1)


def run_part(
    name: str,
    run: Callable[[int, int], int],
    seed: int,
    numbers: Iterable[int],
    goal: int,
    until: float,
    watch: Watch,
) -> int:
    """Run the cases of one part until there were so many calls or files; return the number of findings."""
    start = time.monotonic()
    count = findings = 0
    for number in numbers:
        if count >= goal or time.monotonic() > until:
            break
        command = f"(cd tests && ../.venv/bin/python -m fuzz --seed {seed} --only {name}:{number})"
        watch.begin(command)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                warnings.simplefilter("ignore", UserWarning)  # stereokit's own, on images that hardly match
                count += run(seed, number)
        except Exception as error:
            count, findings = count + 1, findings + 1
            place = traceback.extract_tb(error.__traceback__)[-1]
            message = " ".join(str(error).split())[:300]
            print(
                f"finding: {type(error).__name__}: {message}\n  at {place.filename}:{place.lineno}\n  repeat: {command}"
            )
            sys.stdout.flush()
            if goal == 1:
                traceback.print_exc()
    seconds = time.monotonic() - start
    print(f"{name}: {count} of {goal}, {findings} findings, {seconds:.0f} s", flush=True)
    return findings


def main() -> int:
    """Run what the command line asks for; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--calls", type=int, default=20_000, help="calls to generate")
    parser.add_argument("--files", type=int, default=4_000, help="files to mutate")
    parser.add_argument("--minutes", type=float, default=10, help="bound of both; files take a third at most")
    parser.add_argument("--only", metavar="PART:NUMBER", help="one case, such as calls:17, with its traceback")
    chosen = parser.parse_args()
    start, watch = time.monotonic(), Watch()
    with TemporaryDirectory() as folder:
        parts: dict[str, tuple[Callable[[int, int], int], int, float]] = {
            "files": (lambda seed, number: run_file(seed, number, Path(folder)), chosen.files, 1 / 3),
            "calls": (run_call, chosen.calls, 1.0),
        }
        if chosen.only is not None:
            name, _, number = chosen.only.partition(":")
            return min(1, run_part(name, parts[name][0], chosen.seed, [int(number)], 1, float("inf"), watch))
        print(f"seed {chosen.seed}, {chosen.files} files, {chosen.calls} calls, {chosen.minutes:g} minutes", flush=True)
        findings = 0
        for name, (run, goal, share) in parts.items():
            until = start + 60 * chosen.minutes * share
            findings += run_part(name, run, chosen.seed, numbers_from(0), goal, until, watch)
    return min(1, findings)


if __name__ == "__main__":
    sys.exit(main())
