"""./run of a copy of the project, with a uv and a DVC that only print their commands."""

import shutil
import subprocess
import sys
from pathlib import Path

from pipeline.side_by_side import ENDS

COPIED = (
    "run", "pyproject.toml", "uv.lock", ".python-version", "pipeline/around_dvc.py", "params.yaml",
    "params.expert.yaml", "datasets/papers/params.yaml",
)  # fmt: skip
# the whole command is kept beside; of commands only python is run, which is ours
UV = """\
#!/bin/sh
echo uv "$@" >'{folder}/asked'
while [ "$1" != python ]; do
    [ $# -gt 1 ] || exit 0
    shift
done
shift
exec {python} "$@"
"""
DVC = 'def main(arguments):\n    print("dvc", *arguments)\n    return {status}\n'


def furnish(folder: Path, root: Path, *, status: int = 0) -> None:
    """Copies `run` and its neighbours from `root`. The DVC of the copy ends with `status`. Every loop has
    results of an earlier run."""
    for name in COPIED:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(root / name, folder / name)
    write(folder / "bin/uv", UV.format(python=sys.executable, folder=folder))
    write(folder / "bin/beadline", '#!/bin/sh\necho beadline "$@"\n')
    write(folder / "fake/dvc/cli.py", DVC.format(status=status))
    write(folder / "fake/dvc/__init__.py", "")
    for ends in ENDS.values():
        for end in ends:
            (folder / "datasets" / end).mkdir(parents=True)


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


def environment(folder: Path) -> dict[str, str]:
    """The variables with which the uv and the DVC of the folder are found."""
    return {
        "PATH": f"{folder}/bin:/usr/bin:/bin",
        "PYTHONPATH": f"{folder}/fake",
        "PYTHONDONTWRITEBYTECODE": "1",
    }


def run(folder: Path, *command: str, **outside: str) -> subprocess.CompletedProcess:
    """./run COMMAND in a furnished folder, with these variables set before."""
    return subprocess.run(
        ["./run", *command],
        cwd=folder,
        env=environment(folder) | outside,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def asked(folder: Path) -> str:
    """The command of uv."""
    return (folder / "asked").read_text().strip()
