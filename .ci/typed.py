"""Types in CI: the share of functions whose arguments and result are annotated, and the number of places that
the checker is told to ignore. Ends with status 1 where one of them is worse than recorded in .ci/typed.json.

`./run python .ci/typed.py --record` asks the checker anew, and writes ty.toml and both numbers.
"""

import ast
import json
import re
import subprocess
import sys
import tempfile
import tomllib
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONFIG, RECORD = ROOT / "ty.toml", ROOT / ".ci/typed.json"
CHECKED = ("pipeline", "stages")
HEAD = """# Settings of the type checker: ./run ty check
# Below, by rule, the files that break it: what the checker does not know of numpy, jax and pydantic, and what
# nobody has mended yet. `./run python .ci/typed.py --record` writes these lists; CI refuses longer ones.

[src]
include = ["pipeline", "stages"]
"""


def sources() -> list[Path]:
    return sorted(path for folder in CHECKED for path in (ROOT / folder).rglob("*.py"))


def annotated_percent() -> float:
    """Of all functions, those with every argument (but self and cls) and the result annotated."""
    full, functions = 0, 0
    for path in sources():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                a = node.args
                arguments = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
                named = [one for one in arguments if one.arg not in ("self", "cls")]
                functions += 1
                full += all(one.annotation for one in named) and bool(node.returns or node.name == "__init__")
    return round(100.0 * full / functions, 1)


def ignored() -> int:
    """Pairs of file and rule in ty.toml, and comments in the code that silence a checker."""
    config = tomllib.loads(CONFIG.read_text(encoding="utf-8"))
    listed = sum(len(one["include"]) * len(one["rules"]) for one in config.get("overrides", []))
    comment = re.compile(r"#\s*(ty|type|pyright|mypy):\s*ignore")
    return listed + sum(len(comment.findall(path.read_text(encoding="utf-8"))) for path in sources())


def broken() -> dict[str, set[str]]:
    """Rule -> the files that break it, as the checker sees them without the lists of ty.toml."""
    with tempfile.NamedTemporaryFile("w", suffix=".toml") as bare:
        bare.write(HEAD)
        bare.flush()
        command = ["ty", "check", *CHECKED, "--config-file", bare.name, "--output-format", "concise"]
        result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if result.returncode > 1:
        sys.exit(f"ty check ended with status {result.returncode}: {result.stderr.strip()}")
    files = defaultdict(set)
    for path, rule in re.findall(
        r"^([^:\n]+\.py):\d+:\d+: (?:error|warning)\[([a-z-]+)\]", result.stdout, re.M
    ):
        files[rule].add(path)
    return files


def record() -> None:
    lists = [
        "\n[[overrides]]\ninclude = [\n"
        + "".join(f'    "{path}",\n' for path in sorted(paths))
        + f']\nrules = {{ {rule} = "ignore" }}\n'
        for rule, paths in sorted(broken().items())
    ]
    CONFIG.write_text(HEAD + "".join(lists), encoding="utf-8")
    numbers = {"annotated_percent": annotated_percent(), "ignored": ignored()}
    RECORD.write_text(json.dumps(numbers, indent=2) + "\n", encoding="utf-8")


def main() -> None:
    if sys.argv[1:] == ["--record"]:
        record()
    recorded = json.loads(RECORD.read_text(encoding="utf-8"))
    annotated, silenced = annotated_percent(), ignored()
    print(f"fully annotated functions: {annotated} % (recorded {recorded['annotated_percent']} %)")
    print(f"ignored, by file and rule: {silenced} (recorded {recorded['ignored']})")
    if annotated < recorded["annotated_percent"] or silenced > recorded["ignored"]:
        sys.exit(
            "types: worse than recorded in .ci/typed.json; annotate what is new, or mend what it ignores"
        )


if __name__ == "__main__":
    main()
