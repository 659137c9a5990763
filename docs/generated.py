"""The parts of the reference that the code itself states, made when Sphinx builds the pages.

A page says `<!-- generated: NAME -->` at the place of a part. PARTS has the function of each NAME: it returns
Markdown. Nothing is copied into git, so that no part can be out of date.
"""

import argparse
import importlib
import inspect
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

import stages
from pipeline import cli
from pipeline.report.shared import words
from pipeline.store import params
from pipeline.store.tables import Schema

ROOT = Path(__file__).resolve().parents[1]
LOOPS = ("temperature", "deposition", "setpoint")
# the end of a parameter's name -> its unit
UNITS = {
    "mm3_per_s_per_mm": "mm³/s per mm", "mm_per_s2": "mm/s²", "mm_per_s": "mm/s", "percent_per_s": "%/s",
    "percent_per_step": "%/sample",
    "frames_per_s": "frames/s", "mm_per_px": "mm/pixel", "mm3": "mm³", "mm2": "mm²", "mm": "mm", "um": "µm",
    "degC": "°C", "deg": "°", "percent": "%", "points": "percentage points", "ms": "ms", "s": "s", "h": "h",
    "hz": "Hz", "px": "pixels", "mb": "MB", "steps": "samples", "samples": "samples", "days": "days",
}  # fmt: skip
LIMITS = {"minimum": "≥ {}", "exclusiveMinimum": "> {}", "maximum": "≤ {}", "exclusiveMaximum": "< {}",
          "minLength": "at least {} characters", "maxLength": "at most {} characters",
          "minItems": "at least {} items", "maxItems": "at most {} items"}  # fmt: skip


def table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A table in Markdown. A bar in a cell is escaped, a line break becomes a space."""
    lines = [list(head), ["---" for _ in head], *([str(cell) for cell in row] for row in rows)]
    cells = [[re.sub(r"\s+", " ", cell).replace("|", "\\|") for cell in line] for line in lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def first_sentence(text: str | None) -> str:
    """The first sentence of a docstring, without what follows its first paragraph."""
    paragraph = " ".join((text or "").split("\n\n")[0].split())
    return re.split(r"(?<=[.:]) (?=[A-Z])", paragraph)[0]


# ---- commands


def commands() -> str:
    """Each command with its usage, options, example and exit statuses, by the groups of `--help`."""
    parsers = cli.choices(cli.parser())
    parts = []
    for group, lines in cli.GROUPS.items():
        parts.append(f"## {group}")
        for name in [one for one in cli.COMMANDS if one.split()[0] in lines]:
            command = parsers[name.split()[-1]]
            about = " ".join((cli.COMMANDS[name].run.__doc__ or "").split())
            usage = " ".join(command.format_usage().removeprefix("usage: ").split())
            parts += [
                f"### {name}",
                f"{cli.WITHIN.get(name, lines[name.split()[0]])}. {about}",
                f"```text\n{usage}\n```",
                _options(command),
            ]
            parts.append(f"Example: `./run beadline {f'{name} {cli.COMMANDS[name].example}'.strip()}`")
    return "\n\n".join(parts)


def _options(command: argparse.ArgumentParser) -> str:
    actions = [action for action in command._actions if not isinstance(action, argparse._HelpAction)]
    rows = [
        (
            f"`{', '.join(action.option_strings) or action.metavar or action.dest}`",
            (action.help or "").replace("%%", "%"),
            ""
            if action.default in (None, False, "") or action.default != action.default
            else f"`{action.default}`",
        )
        for action in actions
    ]
    return table(("Argument", "Effect", "Default"), rows) if rows else "No options."


def exit_codes() -> str:
    """The exit statuses of the commands and of `nightly`: meaning, and what to do."""
    return "\n\n".join(
        f"`{name}`:\n\n"
        + table(("Code", "Meaning", "What to do"), [(code, *words) for code, words in statuses.items()])
        for name, statuses in (
            ("./run beadline COMMAND", cli.STATUSES),
            ("./run beadline nightly", cli.NIGHTLY_STATUSES),
        )
    )


# ---- parameters


def parameters() -> str:
    """A table a section: each key with unit, bounds, default, meaning and the stages that read it."""
    readers, comments = _readers(), _comments()
    defaults = {name: file for path in (params.FILE, params.EXPERT) for name, file in _flat(_load(path))}
    parts = []
    for section in sorted(stages.SECTIONS):
        schema = stages.model(section).model_json_schema()
        rows = [
            (f"`{key}`", _unit(key), _bounds(field), _default(defaults, key, field), comments.get(key, ""))
            for key, field in _leaves(schema, schema.get("$defs", {}), section)
        ]
        read = (
            ", ".join(f"`{stage}`" for stage in readers.get(section, [])) or "a command, or the nightly run"
        )
        parts.append(
            f"## {section}\n\n{_purpose(schema)}\n\nRead by: {read}.\n\n"
            + table(("Key", "Unit", "Type and bounds", "Default", "Meaning"), rows)
        )
    return "\n\n".join(parts)


def _purpose(schema: Mapping[str, Any]) -> str:
    """The first sentence of a section's docstring, without the section's name before it."""
    sentence = re.sub(r"^Section `\w+`[:.] ?", "", first_sentence(schema.get("description")))
    return sentence[:1].upper() + sentence[1:]


def _load(path: str) -> dict[str, Any]:
    return yaml.safe_load((ROOT / path).read_text(encoding="utf-8")) or {}


def _flat(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value), of a mapping both the whole and its parts."""
    for key, value in values.items():
        yield f"{before}{key}", value
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{key}.")


def _leaves(schema: Mapping[str, Any], kinds: Mapping[str, Any], key: str) -> Iterator[tuple[str, dict]]:
    """(dotted key, JSON schema) of each value of a section; `[]` stands for each item of a list."""
    for kind in [schema, *schema.get("anyOf", [])]:
        if reference := kind.get("$ref"):
            yield from _leaves(kinds[reference.rpartition("/")[2]], kinds, key)
        for name, field in kind.get("properties", {}).items():
            inner = list(_leaves(field, kinds, f"{key}.{name}"))
            yield from inner or [(f"{key}.{name}", field)]
        if isinstance(kind.get("items"), Mapping):
            yield from _leaves(kind["items"], kinds, f"{key}[]")


def _unit(key: str) -> str:
    name = key.rpartition(".")[2]
    return next((unit for end, unit in UNITS.items() if f"_{name}".endswith(f"_{end}")), "")


def _bounds(field: Mapping[str, Any]) -> str:
    """The type with its limits, or the values that are allowed."""
    if kinds := field.get("anyOf"):
        return " or ".join(dict.fromkeys(_bounds(kind) for kind in kinds))
    if choices := field.get("enum") or ([field["const"]] if "const" in field else []):
        return ", ".join(f"`{json.dumps(choice)}`" for choice in choices)
    limits = [text.format(f"{field[key]:g}") for key, text in LIMITS.items() if key in field]
    items = field.get("items")
    inner = f" of {_bounds(items)}" if isinstance(items, Mapping) else ""
    return ", ".join([f"{field.get('type', 'any')}{inner}", *limits])


def _default(values: Mapping[str, Any], key: str, field: Mapping[str, Any]) -> str:
    if key not in values and "default" not in field:
        return ""
    text = json.dumps(values.get(key, field.get("default")), ensure_ascii=False)
    return f"`{text}`" if len(text) <= 60 else "see the file"


def _readers() -> dict[str, list[str]]:
    """Section -> the stages that dvc.yaml says read it."""
    readers: dict[str, list[str]] = {}
    for stage, wiring in _load("dvc.yaml")["stages"].items():
        names = [
            name
            for one in wiring.get("params", [])
            for name in ([one] if isinstance(one, str) else sum(one.values(), []))
        ]
        for section in dict.fromkeys(name.split(".")[0] for name in names):
            readers.setdefault(section, []).append(stage)
    return readers


def _comments() -> dict[str, str]:
    """Dotted key -> the comment behind its line in the parameter files."""
    found = {}
    for path in (params.FILE, params.EXPERT):
        parents: list[tuple[int, str]] = []
        for line in (ROOT / path).read_text(encoding="utf-8").splitlines():
            if match := re.match(r"( *)(\w+):.*?(?:\s#\s*(.*))?$", line):
                indent = len(match[1])
                parents = [one for one in parents if one[0] < indent] + [(indent, match[2])]
                found[".".join(name for _, name in parents)] = match[3] or ""
    return found


# ---- stages, tables, metrics


def wiring() -> str:
    """What each stage reads, which parameters it has, and what it writes, from dvc.yaml."""
    parts = []
    for stage, wires in _load("dvc.yaml")["stages"].items():
        outs = [next(iter(out)) if isinstance(out, Mapping) else out for out in wires.get("outs", [])]
        data = [dep for dep in wires["deps"] if dep.startswith(("datasets/", "reports/"))]
        code = [dep for dep in wires["deps"] if dep not in data]
        lists = {"Reads": data, "Writes": outs, "Code": code}.items()
        text = "\n".join(
            f"- {name}: {', '.join(f'`{path}`' for path in paths)}" for name, paths in lists if paths
        )
        module = importlib.import_module(f"stages.{stage}")
        parts.append(f"## {stage}\n\n{first_sentence(module.__doc__)}\n\n{text}")
    return "\n\n".join(parts)


def tables() -> str:
    """Each table that a stage writes: columns, types, units, ranges and meanings, from its schema."""
    schemas = {
        value.name: value
        for module in [*(f"pipeline.{loop}.tables" for loop in LOOPS), *_stage_modules()]
        for value in vars(importlib.import_module(module)).values()
        if isinstance(value, Schema)
    }
    return "\n\n".join(
        f"## {name}\n\nVersion {schema.version}.\n\n"
        + table(
            ("Column", "Type", "Unit", "Range", "Meaning"),
            [
                (f"`{c.name}`", c.type, "" if c.unit == "1" else c.unit, _range(c.low, c.high), c.meaning)
                for c in schema.columns
            ],
        )
        for name, schema in sorted(schemas.items())
    )


def _stage_modules() -> list[str]:
    return [f"stages.{path.stem}" for path in sorted((ROOT / "stages").glob("[a-z]*.py"))]


def _range(low: float | None, high: float | None) -> str:
    return ", ".join(f"{sign} {limit:g}" for sign, limit in (("≥", low), ("≤", high)) if limit is not None)


def metrics() -> str:
    """The figures of each stage that git keeps in reports/metrics/<stage>.json; `*` stands for any name."""
    modules = {name.partition(".")[2]: importlib.import_module(name) for name in _stage_modules()}
    rows = [
        (f"`{stage}`", f"`{key}`", _unit(key.replace("*", "")))
        for stage, module in modules.items()
        for key in getattr(module, "METRICS", ())
    ]
    return table(("Stage", "Figure", "Unit"), rows)


# ---- words and public names


def glossary() -> str:
    """The words of the pages, in the order of the alphabet, as the pages explain them."""
    meanings: dict[str, list[str]] = {}
    for word, meaning in sorted(words.FIXED.values(), key=lambda pair: pair[0].lower()):
        meanings.setdefault(word, []).append(meaning)
    entries = (f"{word}\n  {' '.join(texts)}" for word, texts in meanings.items())
    return "```{glossary}\n" + "\n\n".join(entries) + "\n```"


def public_names() -> str:
    """The public functions and classes of each loop, from `__all__` of its package."""
    parts = []
    for loop in LOOPS:
        package = importlib.import_module(f"pipeline.{loop}")
        lines = [f"## {loop.capitalize()}\n\n```{{eval-rst}}", f".. automodule:: pipeline.{loop}"]
        for name in package.__all__:
            value = getattr(package, name)
            kind = "class" if inspect.isclass(value) else "function" if inspect.isroutine(value) else "data"
            lines.append(f".. auto{kind}:: pipeline.{loop}.{name}")
        parts.append("\n\n".join(lines) + "\n```")
    return "\n\n".join(parts)


def plain_docstring(_app: Any, _what: str, _name: str, _object: Any, _options: Any, lines: list[str]) -> None:
    """Changes the lines of a docstring, which is plain text, to reStructuredText that looks the same.

    Equations and what is indented keep their lines; an example stays; signs with a meaning are escaped.
    """
    blocks = []
    for block in "\n".join(lines).split("\n\n"):
        rows = block.split("\n")
        if block.startswith(">>>"):
            blocks.append(block)
        elif all(re.match(r"    |.* (=|<-) .*[^.]$", row) for row in rows):
            blocks.append("::\n\n" + "\n".join(f"    {row}" for row in rows))
        else:
            escaped = re.sub(r"`([^`]*)`|([|*\\]|_(?!\w))", _escape, block)
            blocks.append(escaped)
    lines[:] = "\n\n".join(blocks).split("\n")


def _escape(match: re.Match[str]) -> str:
    return f"\\{match[2]}" if match[2] else f"``{match[1]}``"


PARTS = {
    "commands": commands, "exit codes": exit_codes, "parameters": parameters,
    "stages": wiring, "tables": tables, "metrics": metrics,
    "glossary": glossary, "public names": public_names,
}  # fmt: skip


def fill(text: str) -> str:
    """A page with its parts made. Raises KeyError for a part that no function makes."""
    return re.sub(r"<!-- generated: ([\w ]+) -->", lambda match: PARTS[match[1]](), text)


def setup(app: Any) -> dict[str, bool]:
    """Registers the extension with Sphinx."""
    app.connect("source-read", lambda _app, _name, source: source.__setitem__(0, fill(source[0])))
    app.connect("autodoc-process-docstring", plain_docstring)
    return {"parallel_read_safe": True}
