"""Plants each mutant and prints the table of who caught it and how."""

from __future__ import annotations

import sys
import time

from ptx.mutants.planter import how_caught
from ptx.mutants.table import MUTANTS, SIZES


def main() -> int:
    """Print the table; return how many mutants survive."""
    survivors = 0
    for mutant in MUTANTS:
        start = time.perf_counter()
        how = how_caught(mutant, **SIZES.get(mutant.check, {}))
        survivors += not how
        print(
            f"{mutant.name:52} {mutant.module:24} {mutant.kind:19} {mutant.check:35} {how or 'SURVIVES':20} "
            f"{time.perf_counter() - start:4.1f} s",
            flush=True,
        )
    print(f"{len(MUTANTS) - survivors} of {len(MUTANTS)} caught")
    return survivors


if __name__ == "__main__":
    if sys.argv[1:]:
        sys.exit("usage: python -m ptx.mutants")
    sys.exit(main() > 0)
