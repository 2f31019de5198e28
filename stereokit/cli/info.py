"""The commands ``stereokit list`` and ``stereokit info``: methods and stages, versions and devices."""

from __future__ import annotations

import platform
from typing import Any

from stereokit.cli.options import JsonOption, check_json
from stereokit.cli.output import Table, report, version_of

__all__ = ["info", "list_"]

_STAGE_NAMES = {
    "census": "Census cost",
    "zncc": "ZNCC cost",
    "sgm": "semi-global matching",
    "dt": "domain transform",
}


def list_(json_file: JsonOption = None) -> None:
    """List the methods and their stages."""
    check_json(json_file)
    from stereokit.matching import METHODS
    from stereokit.registry import AGGREGATIONS, COSTS, REFINERS

    methods = {
        name: {"method": stages, "description": " + ".join(_STAGE_NAMES.get(s, s) for s in stages.split("+"))}
        for name, stages in METHODS.items()
    }
    stages = {"costs": COSTS.names(), "aggregations": AGGREGATIONS.names(), "refiners": REFINERS.names()}
    table = Table("Method", "Stages", "What it is")
    for name, entry in methods.items():
        table.add_row(name, entry["method"], entry["description"])
    stage_table = Table("Stage", "Names")
    for kind, names in stages.items():
        stage_table.add_row(kind, ", ".join(names) or "none")
    report({"methods": methods, **stages}, [table, stage_table], json_file)


def info(json_file: JsonOption = None) -> None:
    """Show versions, processor, threads and devices, for bug reports."""
    check_json(json_file)
    import cv2
    import llvmlite.binding
    import numba

    from stereokit.cuda import driver
    from stereokit.kernels import simd, threads

    vector_bits = getattr(simd, "vector_bits", None)
    content: dict[str, Any] = {
        "stereokit": version_of("stereokit"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "numpy": version_of("numpy"),
        "numba": version_of("numba"),
        "llvmlite": version_of("llvmlite"),
        "opencv": cv2.__version__,
        "torch": version_of("torch"),
        "processor": str(llvmlite.binding.get_host_cpu_name()),
        "vector_bits": None if vector_bits is None else vector_bits(),
        "threads": threads.available_threads(),
        "numba_cache": numba.config.CACHE_DIR or "in __pycache__ of the modules",
        "cuda": driver.has_device(),
        "gpu": driver.describe(),
        "numba_cuda": version_of("numba-cuda"),
    }
    table = Table("What", "Value")
    for name, value in content.items():
        words = {None: "not known" if name == "vector_bits" else "not installed", True: "yes", False: "no"}
        table.add_row(name, words[value] if value is None or isinstance(value, bool) else str(value))
    report(content, [table], json_file)
