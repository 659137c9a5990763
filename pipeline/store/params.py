"""Reads a section of params.yaml and params.expert.yaml as a frozen, bounded, typed object.

Each problem with a section becomes one sentence that ends with the remedy. params.yaml holds what the owner
of a machine decides, params.expert.yaml what a developer of a method sets. A section may be in both files,
but each of its keys in only one. A path to params.yaml means both files, because the other one is in the same
folder. The user's own sections begin with x_.
"""

import json
import re
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import pydantic
from pydantic import Field

FILE, EXPERT = "params.yaml", "params.expert.yaml"
# every section that code reads
SECTIONS = (
    "camera",
    "compose_parts",
    "evaluate_setpoint",
    "evaluate_temperature",
    "execution",
    "certify",
    "generate_probing",
    "identify_plant",
    "ingest",
    "learn_kernel",
    "loops",
    "nightly",
    "panel",
    "plant",
    "printer",
    "report",
    "segment_library",
    "setpoint_material",
    "tracking",
    "render_frames",
    "train_classifier",
    "train_ilc",
    "tune_weights",
)
# the second pipeline has a file of its own, which no owner of a machine needs to know
PAPERS, PAPERS_SECTIONS = "datasets/papers/params.yaml", ("reproduce_study", "train_agent")
# old dotted key or section -> new one, for one version
RENAMED: dict[str, str] = {"export_controllers": "certify"}


class Section(pydantic.BaseModel):
    """One section of the two files. Fields have bounds and no defaults but None: only the files hold
    values.

    Types are strict: "true" is no number and 3.5 no integer, but 3 is a float. A list of YAML fills lists and
    tuples. NaN and infinity are refused.
    """

    # the model is built when a section is first checked, because this takes longer than importing most stages
    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True
    )


# ---- sections that belong to no loop


class Loops(Section):
    """Section `loops`: those that the machine has. Stages of the others write that they were not asked."""

    temperature: bool
    deposition: bool
    setpoint: bool

    @pydantic.model_validator(mode="after")
    def _one_is_on(self):
        if not any(self.model_dump().values()):
            raise ValueError("switches every loop off; set temperature, deposition or setpoint to true")
        return self


class Mapped(Section):
    """Where a signal of a recording comes from: source times scale, plus offset."""

    source: str = Field(min_length=1, max_length=300)
    unit: str = Field(min_length=1, max_length=20)
    scale: float = Field(ge=-1e9, le=1e9)
    offset: float = Field(ge=-1e9, le=1e9)


class Execution(Section):
    """Section `execution`: joblib sends its work to one machine (loky) or to a cluster (dask, by the
    address of its scheduler)."""

    backend: Literal["loky", "dask"]
    jobs: int = Field(ge=1, le=64)
    scheduler: str = Field(max_length=200)

    @pydantic.model_validator(mode="after")
    def _scheduler_for_dask_only(self):
        if self.backend == "dask" and not self.scheduler:
            raise ValueError(
                'has backend dask but scheduler ""; write the address of the scheduler there, '
                "such as tcp://host:8786"
            )
        if self.backend != "dask" and self.scheduler:
            raise ValueError(
                f'has scheduler "{self.scheduler}" but backend {self.backend}; set backend: '
                'dask, or scheduler: ""'
            )
        return self


# ---- reading

S = TypeVar("S", bound=Section)


def load(model: type[S], section: str, path: str | Path = FILE) -> S:
    """Returns section `section` of both files as a frozen `model`.

    Raises ValueError with a line for each key that is unknown, renamed, missing or out of bounds, and for
    each section of the files that is not in SECTIONS.
    """
    _check_names(path)
    return _load(model, section, path)


def check(models: Mapping[str, type[Section]], path: str | Path = FILE) -> None:
    """Checks each section named in `models` with its model. Raises ValueError with a line for each problem of
    the two files."""
    problems = _problems_of_names(path)
    misspelt = {_nearest(name, models) for name in {*read(path)}.difference(models)}
    for section, model in models.items():
        if section in misspelt:
            continue  # its keys are below another name
        try:
            _load(model, section, path)
        except ValueError as error:
            problems += str(error).splitlines()
    if problems:
        raise ValueError("\n".join(dict.fromkeys(problems)))


def _load(model: type[S], section: str, path: str | Path) -> S:
    sections = files(path)
    values = _section(section, path)
    try:
        # through JSON, because strict checks there accept a list for a tuple
        return model.model_validate_json(json.dumps(values))
    except pydantic.ValidationError as error:
        problems = _sentences(model, section, error.errors())
        raise ValueError(
            "\n".join(
                f"{_files_of(sections, section, location)}: {sentence}" for location, sentence in problems
            )
        ) from None


def value(dotted: str, path: str | Path = FILE, *, one_of: tuple) -> Any:
    """Returns one key of another stage's section, such as generate_probing.source; its value must be one of
    `one_of`.

    Raises ValueError as `load` does.
    """
    section, *keys = dotted.split(".")
    _check_names(path)
    choice: Any = _section(section, path)
    place = _files_of(files(path), section, keys)
    for key in keys:
        if not isinstance(choice, dict) or key not in choice:
            names = choice if isinstance(choice, dict) else ()
            near = _nearest(key, names)
            remedy = f"is {near} meant?" if near else f"add it (one of {_listed(one_of)})"
            raise ValueError(f"{place}: {dotted} is missing; {remedy}")
        choice = choice[key]
    if not any(type(choice) is type(allowed) and choice == allowed for allowed in one_of):
        raise ValueError(
            f"{place}: {dotted} is {_shown(choice)} but must be one of "
            f"{_listed(one_of)}{_choice_remedy(choice, one_of)}"
        )
    return choice


def home(dotted: str, path: str | Path = FILE) -> str:
    """Returns the file that has a key such as train_agent.seed, "" if neither has it."""
    for name, values in files(path).items():
        for key in dotted.split("."):
            if not isinstance(values, dict) or key not in values:
                break
            values = values[key]
        else:
            return name
    return ""


def read(path: str | Path = FILE) -> dict:
    """Returns every section with its keys from both files, unchecked.

    Raises ValueError as `files` does, and if a key of a section is in both files.
    """
    (name, merged), *others = files(path).items()
    for other, sections in others:
        for section, keys in sections.items():
            mine = merged.get(section, {})
            for file, part in ((name, mine), (other, keys)):
                if type(part) is not dict:
                    raise ValueError(f"{file}: {section} {_NO_SECTION.format(_shown(part))}")
            twice = [key for key in keys if key in mine]
            if twice:
                raise ValueError(
                    f"{name} and {other}: {section}.{twice[0]} stands in both; take it out of one of the two"
                )
            merged[section] = mine | keys
    return merged


def files(path: str | Path = FILE) -> dict[str, dict]:
    """Returns {file: its sections} for params.yaml and, if it exists, for params.expert.yaml in the same
    folder, unchecked.

    Raises ValueError with file and line if a file is not YAML or has a key twice.
    """
    from pipeline.store import params_text

    expert, by_file = Path(path).with_name(EXPERT), {}
    for name in (path, *([expert] if expert.exists() else [])):
        sections = params_text.read(name)
        if type(sections) is not dict:
            raise ValueError(
                f"{name} must hold sections (name: and indented keys) but holds {_shown(sections)}; "
                f"restore it with git checkout {name}"
            )
        by_file[str(name)] = sections
    return by_file


def _section(section: str, path: str | Path) -> dict:
    sections = read(path)
    if section not in sections:
        from pipeline.store import params_text

        expert = Path(path).with_name(EXPERT)
        if not expert.exists():
            remedy = params_text.RESTORE.format(expert)
            raise ValueError(f"{path}: section {section} is missing, and so is {expert}; {remedy}")
        raise ValueError(
            f"{_files_of(files(path), section)}: section {section} is missing; "
            f"add {section}: with its keys below it"
        )
    if type(sections[section]) is not dict:
        raise ValueError(f"{home(section, path)}: {section} {_NO_SECTION.format(_shown(sections[section]))}")
    return sections[section]


def _check_names(path: str | Path) -> None:
    if problems := _problems_of_names(path):
        raise ValueError("\n".join(problems))


def _problems_of_names(path: str | Path) -> list[str]:
    """Returns a sentence for each section that no code reads."""
    return [
        f"{file}: {_no_section(str(name))}"
        for file, sections in files(path).items()
        for name in sections
        if name not in (PAPERS_SECTIONS if file.endswith(PAPERS) else SECTIONS)
        and not str(name).startswith("x_")
    ]


def _files_of(sections: dict[str, dict], section: str, location: Sequence = ()) -> str:
    """Returns the file that has a key. For a missing key, and for the section itself, returns the files that
    have the section."""
    having = [name for name, names in sections.items() if section in names] or list(sections)
    exact = [name for name in having if location and location[0] in sections[name].get(section, {})]
    return (" or " if location else " and ").join(exact or having)


# ---- the sentences

_NO_SECTION = "must be a section with keys below it but is {}; indent its keys by two spaces"
_BOUNDS = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}
_COMPARISONS = {"greater_than_equal": "ge", "greater_than": "gt", "less_than_equal": "le", "less_than": "lt"}
_TYPES = {
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "finite_number": "a finite number",
    "string_type": "a text",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "model_type": "a section with keys below it",
    "model_attributes_type": "a section with keys below it",
    "dict_type": "a section with keys below it",
}


def _sentences(model: type[Section], section: str, errors: list) -> Iterator[tuple[tuple, str]]:
    """Yields (location, sentence) of each problem. A misspelt or renamed key is one problem, not an unknown
    key and a missing one."""
    explained = set()
    for error in errors:
        if error["type"] == "extra_forbidden":
            *above, name = error["loc"]
            old = _dotted(section, error["loc"])
            if old in RENAMED:
                explained.add(RENAMED[old])
                yield error["loc"], f"{old} was renamed to {RENAMED[old]}"
                continue
            parent = _at(model, tuple(above))
            is_section = isinstance(parent, type) and issubclass(parent, Section)
            names = tuple(parent.model_fields) if is_section else ()
            near = _nearest(name, names)
            explained.add(_dotted(section, (*above, near)))
            remedy = f"did you mean {near}?" if near else f"remove it, or use {_listed(names)}"
            yield error["loc"], f"{_place(section, error['loc'])} is unknown; {remedy}"
    for error in errors:
        if error["type"] == "missing" and _dotted(section, error["loc"]) not in explained:
            remedy = f"add it ({_expected(model, error['loc'])})"
            yield error["loc"], f"{_place(section, error['loc'])} is missing; {remedy}"
        elif error["type"] not in ("missing", "extra_forbidden"):
            yield error["loc"], f"{_place(section, error['loc'])} {_complaint(section, error)}"


def _dotted(section: str, location: Sequence) -> str:
    return ".".join(map(str, (section, *location)))


def _no_section(name: str) -> str:
    if name in RENAMED:
        return f"{name} was renamed to {RENAMED[name]}"
    if name in PAPERS_SECTIONS:
        return f"{name} has moved to {PAPERS}; delete it here"
    near = _nearest(name, SECTIONS)
    remedy = f"did you mean {near}?" if near else "remove it, or begin its name with x_ if it is yours"
    return f"{name} is no section; {remedy}"


def _complaint(section: str, error: dict) -> str:
    kind, context, shown = error["type"], error.get("ctx", {}), _shown(error["input"])
    if kind in _COMPARISONS:
        bound = _COMPARISONS[kind]
        return f"is {shown} but must be {_BOUNDS[bound]} {context[bound]:g}"
    if kind in _TYPES:
        return f"is {shown} but must be {_TYPES[kind]}"
    if kind == "literal_error":
        choices = context["expected"]
        remedy = _choice_remedy(error["input"], choices)
        return f"is {shown} but must be one of {choices.replace(chr(39), '')}{remedy}"
    if kind in ("too_short", "string_too_short"):
        counted = "entries" if kind == "too_short" else "characters"
        return f"is {shown} but needs at least {context.get('min_length')} {counted}"
    if kind in ("too_long", "string_too_long"):
        counted = "entries" if kind == "too_long" else "characters"
        return f"is {shown} but takes at most {context.get('max_length')} {counted}"
    if kind == "value_error":
        message = str(context["error"])
        # a problem between the keys of a section is described without repeating the section
        return message if isinstance(error["input"], dict) else f"is {shown} {message}"
    return f"is {shown}: {error['msg'][0].lower()}{error['msg'][1:]}"


def _place(section: str, location: tuple) -> str:
    return section + "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in location)


def _shown(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _nearest(name: Any, names) -> str:
    """Returns the name that is most like `name`, "" if none is similar."""
    import difflib

    matches = difflib.get_close_matches(str(name), [str(other) for other in names], n=1, cutoff=0.6)
    return next(iter(matches), "")


def _choice_remedy(value: Any, choices) -> str:
    """Returns the words that suggest the allowed choice most like a refused value, "" if none is similar."""
    words = re.findall(r"'([^']*)'", choices) if isinstance(choices, str) else choices
    near = _nearest(value, words)
    return f"; did you mean {near}?" if near else ""


def _listed(names) -> str:
    return ", ".join(str(name) for name in names) or "nothing"


def _at(model: Any, location: tuple) -> Any:
    """Returns the type that the schema has at a location: a Section, the type of an element or, at the end,
    of the field itself."""
    for key in location:
        if isinstance(model, type) and issubclass(model, Section):
            model = model.model_fields[key].annotation if key in model.model_fields else None
        else:
            arguments = [
                argument for argument in typing.get_args(model) if argument not in (Ellipsis, type(None))
            ]
            model = arguments[-1] if arguments else None
        if typing.get_origin(model) in (typing.Union, types.UnionType):
            model = next(argument for argument in typing.get_args(model) if argument is not type(None))
        if typing.get_origin(model) is Annotated:
            model = typing.get_args(model)[0]
    return model


def _expected(model: type[Section], location: tuple) -> str:
    """Returns what a missing key should be: "int, at least 1 and at most 20", "one of loky, dask", "section
    with name, unit"."""
    kind = _at(model, location)
    if typing.get_origin(kind) is Literal:
        return "one of " + _listed(typing.get_args(kind))
    if isinstance(kind, type) and issubclass(kind, Section):
        return "section with " + _listed(kind.model_fields)
    owner = _at(model, location[:-1])
    bounds = [
        f"{words} {getattr(limit, name):g}"
        for limit in owner.model_fields[location[-1]].metadata
        for name, words in _BOUNDS.items()
        if hasattr(limit, name)
    ]
    name = (typing.get_origin(kind) or kind).__name__
    return f"{name}, {' and '.join(bounds)}" if bounds else name
