"""Without numba-cuda there are no kernels to test here; `pip install -e ".[dev]"` brings it."""

from __future__ import annotations

import importlib.util

collect_ignore_glob = [] if importlib.util.find_spec("numba_cuda") else ["test_*.py"]
