"""params.yaml and params.expert.yaml are the only home of a value, and
whatever is wrong with them is said in one sentence."""

import re
from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import Field

from pipeline.store import params
from pipeline.store.params import Execution, Section
from pipeline.temperature.settings import Plant


class LearnKernel(Section):
    horizon: int = Field(ge=1, le=20)
    gamma: float = Field(gt=0, lt=1)
    method: Literal["direct", "window"]
    levels: tuple[Annotated[float, Field(ge=0, le=5)], ...] = Field(min_length=1)
    progress: bool


GOOD = """
learn_kernel:
  horizon: 6
  gamma: 1e-3
  method: window
  levels: [0, 0.5]
  progress: true
"""

PLANT = """
plant:
  inputs: [{name: heater_1, unit: percent, low: 0, high: 100}]
  outputs: [{name: zone_1, unit: °C, reference: 200}]
  sample_time_s: 1
"""


@pytest.fixture
def load(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def load(text, model=LearnKernel, section="learn_kernel", expert=None):
        (tmp_path / "params.yaml").write_text(text)
        (tmp_path / "params.expert.yaml").unlink(missing_ok=True)
        if expert is not None:
            (tmp_path / "params.expert.yaml").write_text(expert)
        return params.load(model, section)

    return load


def test_a_good_section_becomes_a_frozen_typed_object(load):
    section = load(GOOD)
    assert section == LearnKernel(horizon=6, gamma=0.001, method="window", levels=(0.0, 0.5), progress=True)
    with pytest.raises(ValueError, match="frozen"):
        section.horizon = 3


def test_numbers_are_read_as_dvc_reads_them(load):
    """YAML 1.1, PyYAML's own, takes 1e-3 for a text, `no` for false and 1:30 for 90; DVC reads YAML 1.2."""
    assert load(GOOD).gamma == 0.001
    assert params.read() == {
        "learn_kernel": {
            "horizon": 6,
            "gamma": 0.001,
            "method": "window",
            "levels": [0, 0.5],
            "progress": True,
        }
    }
    with pytest.raises(ValueError, match='progress is "no" but must be true or false'):
        load(GOOD.replace("true", "no"))
    with pytest.raises(ValueError, match='horizon is "1:30" but must be a whole number'):
        load(GOOD.replace("horizon: 6", "horizon: 1:30"))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("horizon: 6", "horizn: 6", "learn_kernel.horizn is unknown; did you mean horizon?"),
        (
            "horizon: 6",
            "horizon: 6\n  zzz: 1",
            "learn_kernel.zzz is unknown; remove it, or use horizon, gamma, method, levels, progress",
        ),
        ("  horizon: 6\n", "", "learn_kernel.horizon is missing; add it (int, at least 1 and at most 20)"),
        ("  gamma: 1e-3\n", "", "learn_kernel.gamma is missing; add it (float, more than 0 and less than 1)"),
        ("  method: window\n", "", "learn_kernel.method is missing; add it (one of direct, window)"),
        ("horizon: 6", "horizon: 25", "learn_kernel.horizon is 25 but must be at most 20"),
        ("horizon: 6", "horizon: 3.5", "learn_kernel.horizon is 3.5 but must be a whole number"),
        ("horizon: 6", "horizon: true", "learn_kernel.horizon is true but must be a whole number"),
        ("gamma: 1e-3", "gamma: '0.1'", 'learn_kernel.gamma is "0.1" but must be a number'),
        ("gamma: 1e-3", "gamma: true", "learn_kernel.gamma is true but must be a number"),
        ("gamma: 1e-3", "gamma:", "learn_kernel.gamma is null but must be a number"),
        ("gamma: 1e-3", "gamma: .nan", "learn_kernel.gamma is NaN but must be a finite number"),
        ("gamma: 1e-3", "gamma: -.inf", "learn_kernel.gamma is -Infinity but must be a finite number"),
        (
            "method: window",
            "method: windw",
            'learn_kernel.method is "windw" but must be one of direct or window; did you mean window?',
        ),
        ("[0, 0.5]", "[0, 7]", "learn_kernel.levels[1] is 7 but must be at most 5"),
        ("[0, 0.5]", "0.5", "learn_kernel.levels is 0.5 but must be a list"),
        ("[0, 0.5]", "[]", "learn_kernel.levels is [] but needs at least 1 entries"),
        (
            "progress: true",
            "progress: true\n  gamma: 0.5",
            "line 8: gamma is given twice, first in line 4; keep one of the two",
        ),
        (
            "progress: true",
            "progress: true\nlearn_kernel: 3",
            "line 8: learn_kernel is given twice, first in line 2; keep one of the two",
        ),
        (
            "  horizon: 6",
            "\thorizon: 6",
            "line 3: found character '\\t' that cannot start any token; mend the line: key: "
            "value, indented by spaces",
        ),
        ("learn_kernel:", "lern_kernel:", "lern_kernel is no section; did you mean learn_kernel?"),
    ],
)
def test_each_mistake_is_one_sentence_with_place_expectation_and_remedy(load, old, new, sentence):
    assert old in GOOD
    with pytest.raises(ValueError, match=f"^{re.escape('params.yaml: ' + sentence)}$"):
        load(GOOD.replace(old, new))


def test_two_mistakes_are_two_lines(load):
    with pytest.raises(
        ValueError,
        match="horizon is 0 but must be at least 1\nparams.yaml: learn_kernel.gamma is 1 but must be less "
        "than 1$",
    ):
        load(GOOD.replace("horizon: 6", "horizon: 0").replace("1e-3", "1"))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "must hold sections"),
        ("[1]", "must hold sections"),
        ("learn_kernel: 3", "must be a section with keys below it but is 3"),
        ("a: \a", "#x0007"),
    ],
)
def test_a_file_without_sections_is_refused(load, text, sentence):
    with pytest.raises(ValueError, match=sentence):
        load(text)


def test_a_missing_file_and_one_that_is_not_text_are_refused(load, tmp_path):
    with pytest.raises(ValueError, match=r"params.yaml is missing; run from the root of the project"):
        params.load(LearnKernel, "learn_kernel")
    (tmp_path / "params.yaml").write_bytes(b"a: \xff")
    with pytest.raises(ValueError, match="byte 3 is not UTF-8; save the file as UTF-8"):
        params.load(LearnKernel, "learn_kernel")


def test_one_key_of_another_section_is_bounded_too(load):
    load(GOOD)
    assert params.value("learn_kernel.method", one_of=("direct", "window")) == "window"
    with pytest.raises(
        ValueError,
        match='learn_kernel.method is "window" but must be one of windows, direct; did you mean windows',
    ):
        params.value("learn_kernel.method", one_of=("windows", "direct"))
    with pytest.raises(ValueError, match=r"learn_kernel.progress is true but must be one of 0, 1"):
        params.value("learn_kernel.progress", one_of=(0, 1))
    with pytest.raises(ValueError, match=r"learn_kernel.metod is missing; is method meant\?"):
        params.value("learn_kernel.metod", one_of=("direct",))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            "zone_1",
            "heater_1",
            "plant names heater_1 more than once; give every input and output a name of its own",
        ),
        (
            "heater_1",
            "1_heater",
            'plant.inputs[0].name is "1_heater" but must consist of letters, '
            "digits and _ and not begin with a digit",
        ),
        (
            "zone_1",
            "time_s",
            'plant.outputs[0].name is "time_s" but that is taken by the table of the record',
        ),
        (
            "zone_1",
            "heater_1_masked",
            'plant.outputs[0].name is "heater_1_masked" but that is taken by the table of the record',
        ),
        ("high: 100", "high: 0", "plant.inputs[0] has low 0 but high 0; low must be less than high"),
        ("high: 100", "hi: 100", "plant.inputs[0].hi is unknown; did you mean high?"),
        ("{name: zone_1, unit: °C, reference: 200}", "", "plant.outputs is [] but needs at least 1 entries"),
        ("sample_time_s: 1", "sample_time_s: 0", "plant.sample_time_s is 0 but must be more than 0"),
    ],
)
def test_the_plant_has_distinct_named_signals_within_limits(load, old, new, sentence):
    assert [signal.name for signal in load(PLANT, Plant, "plant").outputs] == ["zone_1"]
    with pytest.raises(ValueError, match=re.escape(f"params.yaml: {sentence}")):
        load(PLANT.replace(old, new), Plant, "plant")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("{backend: ray, jobs: 2, scheduler: ''}", 'backend is "ray" but must be one of loky or dask'),
        ("{backend: loky, jobs: 0, scheduler: ''}", "jobs is 0 but must be at least 1"),
        (
            "{backend: dask, jobs: 2, scheduler: ''}",
            'has backend dask but scheduler ""; write the address of the scheduler there',
        ),
        (
            "{backend: loky, jobs: 2, scheduler: 'tcp://a:1'}",
            'has scheduler "tcp://a:1" but backend loky; set backend: dask, or scheduler: ""',
        ),
    ],
)
def test_a_cluster_needs_a_scheduler_and_one_machine_has_none(load, text, sentence):
    assert (
        load("execution: {backend: dask, jobs: 2, scheduler: 'tcp://a:1'}", Execution, "execution").backend
        == "dask"
    )
    with pytest.raises(ValueError, match=re.escape(sentence)):
        load(f"execution: {text}", Execution, "execution")


# ---- two files

OWNER = """
ingest: {source: recordings}
learn_kernel:
  method: window
  progress: true
"""
EXPERT = """
learn_kernel: {horizon: 6, gamma: 1e-3, levels: [0, 0.5]}
tracking: {gamma: 0.9}
"""


def test_a_section_may_stand_in_both_files_and_is_one(load, tmp_path):
    assert load(OWNER, expert=EXPERT) == load(GOOD)
    load(OWNER, expert=EXPERT)
    assert params.load(LearnKernel, "learn_kernel", tmp_path / "params.yaml").horizon == 6
    assert params.read()["learn_kernel"] == {
        "method": "window",
        "progress": True,
        "horizon": 6,
        "gamma": 0.001,
        "levels": [0, 0.5],
    }
    assert list(params.read()) == ["ingest", "learn_kernel", "tracking"]
    assert (
        params.value("learn_kernel.horizon", one_of=(6,)) == 6
        and params.value("ingest.source", one_of=("recordings",)) == "recordings"
    )
    assert params.home("learn_kernel.method") == params.home("ingest") == "params.yaml"
    assert params.home("learn_kernel.levels") == params.home("tracking.gamma") == "params.expert.yaml"
    assert params.home("learn_kernel.colour") == params.home("learn_kernel.levels.0") == params.home("") == ""


@pytest.mark.parametrize("twice", ["method: window", "method: direct", "progress:"])
def test_a_key_that_stands_in_both_files_is_refused(load, twice):
    sentence = (
        f"params.yaml and params.expert.yaml: learn_kernel.{twice.split(':')[0]} stands in both; take it "
        f"out of one of the two"
    )
    with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
        load(OWNER, expert=f"learn_kernel:\n  horizon: 6\n  {twice}\n")


@pytest.mark.parametrize(
    ("owner", "expert", "sentence"),
    [
        (
            ("method: window", "method: window\n  metod: 1"),
            ("", ""),
            "params.yaml: learn_kernel.metod is unknown; did you mean method?",
        ),
        (
            ("", ""),
            ("gamma: 1e-3", "gama: 1e-3"),
            "params.expert.yaml: learn_kernel.gama is unknown; did you mean gamma?",
        ),
        (("", ""), ("1e-3", "2"), "params.expert.yaml: learn_kernel.gamma is 2 but must be less than 1"),
        (
            ("", ""),
            ("[0, 0.5]", "[0, 7]"),
            "params.expert.yaml: learn_kernel.levels[1] is 7 but must be at most 5",
        ),
        (
            ("", ""),
            ("horizon: 6, ", ""),
            "params.yaml or params.expert.yaml: learn_kernel.horizon is missing; "
            "add it (int, at least 1 and at most 20)",
        ),
        (
            ("", ""),
            ("tracking:", "  tracking:"),
            "params.expert.yaml: line 3: expected <block end>, but found '<block mapping start>'; "
            "mend the line: key: value, indented by spaces",
        ),
        (
            ("", ""),
            ("learn_kernel: {horizon: 6, gamma: 1e-3, levels: [0, 0.5]}", "learn_kernel:"),
            "params.expert.yaml: learn_kernel must be a section with keys below it but is null; "
            "indent its keys by two spaces",
        ),
    ],
)
def test_a_mistake_is_said_with_the_file_in_which_it_stands(load, owner, expert, sentence):
    assert owner[0] in OWNER and expert[0] in EXPERT
    with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
        load(
            OWNER.replace(*owner) if owner[0] else OWNER,
            expert=EXPERT.replace(*expert) if expert[0] else EXPERT,
        )


def test_what_is_wrong_between_keys_of_both_files_names_both(load):
    with pytest.raises(
        ValueError, match=r'^params.yaml and params.expert.yaml: execution has backend dask but scheduler ""'
    ):
        load("execution: {jobs: 2}", Execution, "execution", "execution: {backend: dask, scheduler: ''}")


def test_a_key_or_a_section_that_is_missing_says_where_it_is_looked_for(load):
    load(OWNER, expert=EXPERT)
    with pytest.raises(ValueError, match=r"^params.expert.yaml: tracking.gama is missing; is gamma meant\?$"):
        params.value("tracking.gama", one_of=(1,))
    with pytest.raises(
        ValueError, match=r"^params.yaml: ingest.source is \"recordings\" but must be one of simulated$"
    ):
        params.value("ingest.source", one_of=("simulated",))
    with pytest.raises(
        ValueError,
        match=r"^params.yaml and params.expert.yaml: section colours is missing; add colours: with its keys "
        r"below it$",
    ):
        params.load(LearnKernel, "colours")
    with pytest.raises(
        ValueError,
        match=r"^params.yaml: section colours is missing, and so is params.expert.yaml; run from .* git "
        r"checkout params.expert.yaml$",
    ):
        load(OWNER, section="colours")


# ---- sections that nothing reads


@pytest.mark.parametrize(
    ("owner", "expert", "sentence"),
    [
        (
            "lern_kernel: {horizon: 9}",
            "",
            "params.yaml: lern_kernel is no section; did you mean learn_kernel?",
        ),
        (
            "",
            "generate_probin: {samples: 9}",
            "params.expert.yaml: generate_probin is no section; did you mean generate_probing?",
        ),
        (
            "",
            "colours: {}",
            "params.expert.yaml: colours is no section; remove it, or begin its name with x_ if it is yours",
        ),
        (
            "",
            "7: {}",
            "params.expert.yaml: 7 is no section; remove it, or begin its name with x_ if it is yours",
        ),
        # as .ci/params.yaml writes a change, and as a command line does
        (
            "learn_kernel.horizon: 3",
            "",
            "params.yaml: learn_kernel.horizon is no section; did you mean learn_kernel?",
        ),
        ("", "trackng: {}", "params.expert.yaml: trackng is no section; did you mean tracking?"),
        (
            "learn: {}",
            "panl: {}",
            "params.yaml: learn was renamed to learn_kernel\n"
            "params.expert.yaml: panl is no section; did you mean panel?",
        ),
    ],
)
def test_a_section_that_nothing_reads_is_refused_whatever_section_is_loaded(
    load, monkeypatch, owner, expert, sentence
):
    monkeypatch.setattr(params, "RENAMED", {"learn": "learn_kernel"})
    texts = f"{OWNER}{owner}\n", f"{EXPERT}{expert}\n"
    with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
        load(texts[0], expert=texts[1])
    with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
        params.value("learn_kernel.method", one_of=("window",))


def test_a_renamed_key_is_refused_with_its_new_name_alone(load, monkeypatch):
    monkeypatch.setattr(params, "RENAMED", {"learn_kernel.steps": "learn_kernel.horizon"})
    assert "horizon: " in GOOD
    with pytest.raises(
        ValueError, match=r"^params.yaml: learn_kernel.steps was renamed to learn_kernel.horizon$"
    ):
        load(GOOD.replace("horizon: ", "steps: "))


def test_every_new_name_is_a_key_of_today_and_no_old_one_is(root):
    for old, new in params.RENAMED.items():
        assert params.home(new, root / params.FILE) and not params.home(old, root / params.FILE)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('learn_kernel: {horizon: !!int ""}\n', "params.yaml: "),
        ('learn_kernel: {method: "\\U00110000"}\n', "params.yaml: "),
        ("x_large: " + "1 " * 200_000, "params.yaml has 400009 bytes but may have 200000; "),
    ],
)
def test_hostile_values_and_sizes_are_refused_with_the_name_of_the_file(load, text, sentence):
    load(GOOD)
    Path("params.yaml").write_text(text)
    with pytest.raises(ValueError, match=f"^{re.escape(sentence)}") as refused:
        params.read("params.yaml")
    assert str(refused.value).count("\n") == 0 and ";" in str(refused.value)


def test_a_folder_in_the_place_of_the_parameters_is_refused(load):
    load(GOOD)
    Path("params.yaml").unlink()
    Path("params.yaml").mkdir()
    with pytest.raises(ValueError, match="^params.yaml is no file; "):
        params.read("params.yaml")


def test_a_users_own_section_begins_with_x(load):
    assert load(f"x_colours: {{red: 1}}\n{OWNER}", expert=f"{EXPERT}x_rig: {{}}\n") == load(GOOD)


def test_changes_by_dotted_keys_and_files_of_earlier_versions_are_read_unchecked(load, root):
    load(GOOD)
    Path("changes.yaml").write_text("learn_kernel.horizon: 3\nold_section: {seed: 1}\n")
    assert params.read("changes.yaml") == {"learn_kernel.horizon": 3, "old_section": {"seed": 1}}
    assert "generate_probing.samples" in params.read(root / ".ci/params.yaml")


def test_the_sections_are_those_of_the_two_files(root):
    both = {name for sections in params.files(root / params.FILE).values() for name in sections}
    assert {name for name in both if not name.startswith("x_")} == set(params.SECTIONS)


# ---- hostile files

LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{after}: &{after} [{', '.join([f'*{before}'] * 10)}]\n"
    for before, after in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (LAUGHS, "line 1: the anchor &a is refused; write the values out at each place"),
        (
            "a: " + "[" * 90 + "]" * 90,
            "line 1: it is nested deeper than 50 levels; put fewer into each other",
        ),
        ("a: " + "[" * 3000 + "]" * 3000, "it is nested deeper than 50 levels"),
        ("a: " + "{b: " * 3000 + "}" * 3000, "it is nested deeper than 50 levels"),
        ("\n".join(" " * depth + "a:" for depth in range(90)), "line 50: it is nested deeper than 50 levels"),
        ("\n".join(" " * depth + "a:" for depth in range(600)), "it is nested deeper than 50 levels"),
        ("a: &a [*a]", "line 1: the anchor &a is refused"),
        (
            "x: 1\na: {<<: 3}",
            "line 2: the tag tag:yaml.org,2002:merge names no type of parameters; take it out",
        ),
        ("a: " + "9" * 5000, "a number has 5000 digits"),
        ("a: !!python/object/apply:os.system [ls]", "names no type of parameters"),
        ("a: !!timestamp 2020-01-01", 'line 1: 2020-01-01 is a date; write it in quotes: "2020-01-01"'),
        ("a: [1,\n  2020-01-01]", 'line 2: 2020-01-01 is a date; write it in quotes: "2020-01-01"'),
        ("2020-01-01: 1", 'line 1: 2020-01-01 is a date; write it in quotes: "2020-01-01"'),
        ("a: 1_000", "line 1: 1_000 has underscores; write 1000"),
        ("a: -1_0.5e3", "line 1: -1_0.5e3 has underscores; write -10.5e3"),
        ("a: !!bool maybe", "does not fit its tag; take the tag out"),
        ("a: !!int xyz", "does not fit its tag; take the tag out"),
        ("a: 1\n---\nb: 1", "line 2: expected a single document in the stream, but found another document"),
        ("a: *b", "line 1: found undefined alias 'b'"),
        ("? [a, b]\n: 1", "a key is no word"),
        ("a: 1\na: 2", "a is given twice, first in line 1"),
        ("a: \x1b[31m", "unacceptable character"),
    ],
)
@pytest.mark.usefixtures("must_end")
def test_a_hostile_file_is_one_sentence_at_once(load, text, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)) as refused:
        load(text)
    assert str(refused.value).startswith("params.yaml: ")
    assert "\n" not in str(refused.value)


def test_words_dates_and_numbers_in_quotes_are_texts(load):
    load(GOOD + "x_own: {a: '2020-01-01', b: \"1_000\", c: zone_1, d: 1:30, e: no}")
    own = params.read()["x_own"]
    assert own == {"a": "2020-01-01", "b": "1_000", "c": "zone_1", "d": "1:30", "e": "no"}


def test_the_parser_of_dvc_has_its_part_in_c():
    """Without it a repro with nothing to do takes twice as long."""
    import _ruamel_yaml
    from ruamel.yaml import YAML

    assert YAML(typ="safe").Parser is _ruamel_yaml.CParser
