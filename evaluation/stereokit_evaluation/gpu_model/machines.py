"""The GPUs that `stereokit_evaluation.gpu_model.model` models, and published times.

Figures are the makers' where there are any; assumptions are marked. The rates of the units are those of the CUDA C++
Programming Guide, "Throughput of Native Arithmetic Instructions", results per clock of a multiprocessor: 64 for integer
arithmetic and multiplication, 16 for conversions and population counts, 32 for shuffles on compute capability 7.x to
9.0, and 64 (7.x) or 128 (8.6 to 9.0) for floats.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from stereokit_evaluation.data.published import PAPER, TABLE_2

__all__ = ["ASSUMED", "LIBSGM_SIZE", "MACHINES", "PUBLISHED", "Machine", "Published", "libsgm_bytes"]


@dataclass(frozen=True)
class Machine:
    """A GPU.

    Attributes
    ----------
    name : str
    architecture : str
        Target of the assembled code.
    multiprocessors : int
    ghz : float
        Clock.
    gb_per_s : float
        Peak bandwidth of its memory, 10**9 bytes a second.
    floats : int
        Additions or multiplications of floats of a multiprocessor per clock.
    latency : int
        Clocks until memory answers; assumed.
    launch_us : float
        Microseconds from launch to launch out of Python; assumed.
    source : str
        Source of the figures.
    """

    name: str
    architecture: str
    multiprocessors: int
    ghz: float
    gb_per_s: float
    floats: int
    latency: int
    launch_us: float
    source: str

    @property
    def rates(self) -> Mapping[str, int]:
        """Lanes per clock of a multiprocessor by unit (`stereokit_evaluation.gpu_model.sass.UNITS`)."""
        return MappingProxyType(
            {"integer": 64, "multiply": 64, "float": self.floats, "convert": 16, "shuffle": 32, "memory": 32}
        )


MACHINES = (
    Machine(
        "AGX Xavier", "sm_72", 8, 1.377, 136.5, 64, 800, 20,
        "NVIDIA, Jetson AGX Xavier data sheet: 512 cores, 1377 MHz (MAXN), 256-bit LPDDR4x at 4266 MT/s",
    ),
    Machine(
        "AGX Orin", "sm_87", 16, 1.3, 204.8, 128, 800, 20,
        "NVIDIA, Jetson AGX Orin 64 GB data sheet: 2048 cores, 1.3 GHz, 256-bit LPDDR5 at 6400 MT/s",
    ),
    Machine(
        "RTX 3080", "sm_87", 68, 1.71, 760.3, 128, 500, 10,
        "NVIDIA, Ampere GA102 white paper: 68 SMs, 1.71 GHz, 320-bit GDDR6X at 19 GT/s; code for sm_87 for its sm_86",
    ),
    Machine(
        "H100", "sm_90", 132, 1.755, 3350, 128, 700, 10,
        "NVIDIA, H100 SXM data sheet: 132 SMs, 3.35 TB/s; clock assumed below its boost of 1.98 GHz",
    ),
)  # fmt: skip
"""The GPUs of the tables."""

ASSUMED: Mapping[str, float] = MappingProxyType({"of_bandwidth": 0.75, "dependent": 4.0, "shuffle": 24.0})
"""Assumed of every GPU: the share of the peak bandwidth that a kernel reaches; clocks from an instruction of a warp to
the next that needs it (4 for arithmetic and about 24 for a shuffle; Jia et al., Dissecting the NVIDIA Volta GPU
Architecture via Microbenchmarking, 2018)."""


@dataclass(frozen=True)
class Published:
    """A time that others measured.

    Attributes
    ----------
    name, machine : str
        The program and its GPU.
    size : str
        As in the source.
    ms : float
        Milliseconds of a pair.
    source : str
    """

    name: str
    machine: str
    size: str
    ms: float
    source: str


LIBSGM_SIZE = 1024, 440, 128, 4
"""Width, height, levels and paths of libSGM's published times."""

_LIBSGM = "github.com/fixstars/libSGM, README"
_EMBEDDED = "Hernandez-Juarez et al., Embedded real-time stereo estimation via SGM on the GPU, ICCS 2016"

PUBLISHED = (
    Published("ZNCC+SGM of the paper", "AGX Xavier", "unknown", TABLE_2["ZNCC+SGM"]["AGX"], f"{PAPER}, table II"),
    Published("libSGM, 4 paths", "AGX Xavier", "1024x440, 128 levels", 9.0, _LIBSGM),
    Published("libSGM, 4 paths", "RTX 3080", "1024x440, 128 levels", 1.5, _LIBSGM),
    Published("Hernandez-Juarez, 4 paths", "Tegra X1", "640x480, 128 levels", 1e3 / 42, _EMBEDDED),
)
"""Published times, none of them by us. The paper does not say at which size its ZNCC+SGM ran."""


def libsgm_bytes(pixels: int, levels: int, paths: int) -> int:
    """Return the bytes of libSGM's path volumes: each path's is written once and read once, a byte per cell.

    Its costs are Hamming distances computed again for every path from the bits, so that there is no volume of costs;
    the bits and images, some bytes to a pixel, are not counted.
    """
    return 2 * paths * pixels * levels
