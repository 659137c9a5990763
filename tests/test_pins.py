"""Same inputs, same bytes: what ./run pins wins over what is set
outside, and over how many cores there are."""

import json
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from pipeline.store import artifacts, params

THREADS = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
    "NPROC": "2",
}
KERNELS = {
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "XLA_FLAGS": "--xla_cpu_max_isa=AVX --xla_cpu_experimental_ynn_fusion_type=",
    "TENSORFLOW_USE_CUSTOM_CONTRACTION_KERNEL": "0",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "ARROW_USER_SIMD_LEVEL": "AVX2",
    "OPENCV_IPP": "avx2",
}
OUTSIDE = {
    "OPENBLAS_CORETYPE": "SkylakeX", "NPY_DISABLE_CPU_FEATURES": "", "XLA_FLAGS": "",
    "OPENCV_CPU_DISABLE": "AVX2",
    "OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2", "NPROC": "1",
}  # fmt: skip
STAGES = ("probe_machine", "ingest", "identify_plant", "generate_probing")
SMALL = {
    "execution": {"jobs": 1},
    "generate_probing": {"samples": 2000},
    "identify_plant": {"max_order": 4, "refinement": "none"},
}


@pytest.fixture
def project(root, tmp_path):
    """A copy of the project with small parameters; its environment is the one of this process."""
    tree = tmp_path / "project"
    tree.mkdir()
    for name in ("run", "pyproject.toml", "uv.lock", "README.md"):
        shutil.copy(root / name, tree)
    for name in ("pipeline", "stages"):
        (tree / name).symlink_to(root / name)
    sections = params.read(root / "params.yaml")
    for section, changes in SMALL.items():
        assert changes.keys() <= sections[section].keys()
        sections[section] |= changes
    (tree / "params.yaml").write_text(yaml.safe_dump(sections, sort_keys=False))
    return tree


def run(
    root: Path, tree: Path, *command: str, ahead: tuple[str, ...] = (), **outside: str
) -> subprocess.CompletedProcess:
    """`./run COMMAND` in the tree, with these variables set before; uv takes the environment as it is."""
    environment = os.environ | {
        "PATH": f"{os.environ['PATH']}:{root}/.uv/bin", "UV_PROJECT_ENVIRONMENT": sys.prefix,
        "UV_NO_SYNC": "1", "PYTHONDONTWRITEBYTECODE": "1",
    } | outside  # fmt: skip
    return subprocess.run(
        [*ahead, "./run", *command],
        cwd=tree,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def test_what_is_set_outside_and_a_single_core_change_no_byte(root, project):
    one_core = ("taskset", "-c", str(min(os.sched_getaffinity(0)))) if shutil.which("taskset") else ()
    left = []
    for ahead, outside in (((), {}), (one_core, OUTSIDE)):
        for stage in STAGES:
            ended = run(root, project, "python", "-m", f"stages.{stage}", ahead=ahead, **outside)
            assert ended.returncode == 0, ended.stderr
        written = [
            path
            for folder in ("datasets", "reports/metrics")
            for path in sorted((project / folder).rglob("*"))
            if path.is_file()
        ]
        left.append(
            {
                path.relative_to(project).as_posix(): artifacts.sha256(path)
                for path in written
                if "memo" not in path.parts
            }
        )
        # nothing is remembered: the second run computes all of it again
        for folder in ("datasets", "reports"):
            shutil.rmtree(project / folder)
    assert left[0] == left[1]
    assert {Path(name).parts[1] for name in left[0] if name.startswith("datasets")} == set(STAGES)
    assert {f"reports/metrics/{stage}.json" for stage in STAGES} <= left[0].keys()


@pytest.mark.parametrize(
    ("flags", "kernels"),
    [
        ("fpu avx avx2 fma avx512f", KERNELS | {"OPENCV_CPU_DISABLE": "AVX512-SKX"}),
        ("fpu avx avx2 fma", KERNELS),
        ("fpu avx fma", {}),
        ("fpu avx avx2", {}),
    ],
)
def test_the_pins_are_those_of_the_cpu_whatever_is_set_outside(root, project, flags, kernels):
    cpuinfo = project / "cpuinfo"
    cpuinfo.write_text(f"model name\t: Some CPU\nflags\t\t: {flags}\n" * 2)
    said = "import json, os; print(json.dumps(dict(os.environ)))"
    ended = run(root, project, "python", "-c", said, **OUTSIDE, BEADLINE_CPUINFO=str(cpuinfo))
    found = json.loads(ended.stdout)
    assert {name: found.get(name) for name in THREADS} == THREADS
    assert {name: found[name] for name in {*KERNELS, "OPENCV_CPU_DISABLE"} if name in found} == kernels
    lacking = not kernels and platform.machine() == "x86_64"
    assert ended.stderr == (
        "run: this CPU lacks AVX2 or FMA; last digits may differ from those of other machines\n"
        if lacking
        else ""
    )
