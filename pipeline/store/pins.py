"""The environment variables (pins) that `run` exports. Equal inputs give equal bytes only if every library
sums in the same order."""

import os
from pathlib import Path

# numbers of threads; and instructions, which `run` sets on CPUs with AVX2 and FMA
THREADS = (
    "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM", "NPROC",
)  # fmt: skip
INSTRUCTIONS = (
    "OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES", "XLA_FLAGS", "ONEDNN_MAX_CPU_ISA",
    "TENSORFLOW_USE_CUSTOM_CONTRACTION_KERNEL", "ARROW_USER_SIMD_LEVEL", "OPENCV_IPP",
)  # fmt: skip
PINS = (*THREADS, *INSTRUCTIONS, "OPENCV_CPU_DISABLE")


def check_pins(stage: str) -> None:
    """Raises ValueError if a pin that this machine needs is not set."""
    missing = [name for name in (*THREADS, *INSTRUCTIONS) if name not in os.environ]
    if missing and (missing[0] in THREADS or _has_avx2()):
        raise ValueError(
            f"{missing[0]} is not set, so that last digits could differ from those of other machines; "
            f"start it with ./run dvc repro {stage}"
        )


def _has_avx2() -> bool:
    """Returns whether the CPU has AVX2 and FMA, found in the same way as in `run`."""
    try:
        with Path(os.environ.get("BEADLINE_CPUINFO", "/proc/cpuinfo")).open(encoding="utf-8") as lines:
            flags = next((line.split() for line in lines if line.startswith("flags")), [])
    except OSError:
        return False
    return {"avx2", "fma"} <= set(flags)
