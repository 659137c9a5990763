"""A user of an earlier version goes on: old params files, accepted runs and champions are read under today's
names. The files in version_0_1 were written by version 0.1 (revision 82e0ccc)."""

import json
import shutil
from pathlib import Path

import pytest
from pydantic import Field

from pipeline.deposition.workflow import tables as deposition
from pipeline.setpoint.workflow import tables as setpoint
from pipeline.store import artifacts, params, renamed
from pipeline.store.params import Section
from pipeline.store.tables import COUNT, NONE, Column, Schema
from pipeline.temperature.workflow import tables as temperature

OLD = Path(__file__).with_name("version_0_1")
SCHEMAS = {
    schema.name: schema
    for module in (temperature, deposition, setpoint)
    for schema in vars(module).values()
    if isinstance(schema, Schema)
}


def keys(data, place=""):
    """Every dotted key of nested dictionaries."""
    for name, item in data.items() if isinstance(data, dict) else ():
        key = f"{place}.{name}" if place else str(name)
        yield key
        yield from keys(item, key)


def has(data, names):
    """Whether nested dictionaries have the key; * is any one name."""
    if not names:
        return True
    if not isinstance(data, dict):
        return False
    items = data.values() if names[0] == "*" else [data[names[0]]] if names[0] in data else []
    if any(has(item, names[1:]) for item in items):
        return True
    # a name with a dot of its own
    return len(names) > 1 and has(data, [".".join(names[:2]), *names[2:]])


@pytest.fixture(scope="module")
def measured(root):
    """{stage: metrics} of the last run."""
    files = sorted((root / "reports/metrics").glob("*.json"))
    return renamed.metrics({path.stem: artifacts.read_json(path) for path in files})


# ---- names


NAMES = {
    "train.ours": "train.belief",
    "train.ours.filter.look": "train.belief.filter.width_std",
    "train.belief.steps": "train.belief.n_steps",
    "ilc.*.ours": "ilc.*.inverse",
    "rate_at_0.7": "share_at_0.7",
    "panel.loss": "plant.heat.loss",
}


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("train.ours", "train.belief"),
        ("train.ours.gamma", "train.belief.gamma"),
        # a key below a renamed section, listed under the old and under the new section
        ("train.ours.filter.look", "train.belief.filter.width_std"),
        ("train.belief.filter.look", "train.belief.filter.width_std"),
        ("train.ours.steps", "train.belief.n_steps"),
        ("ilc.B.ours.best", "ilc.B.inverse.best"),
        ("rate_at_0.7", "share_at_0.7"),
        ("train.ourselves", "train.ourselves"),
        ("other", "other"),
    ],
)
def test_the_longest_old_name_is_replaced_and_names_below_it_stay(old, new):
    assert renamed.new_name(old, NAMES) == new


def test_nested_data_come_under_new_names_with_their_values_and_their_order():
    old = {
        "train": {"ours": {"filter": {"look": 1, "gain": 2}, "steps": 3}, "seed": 4},
        "ilc": {"A": {"ours": [{"best": 5}]}, "B": {"pixels": 6}},
        "rate_at_0.7": 7,
        "panel": {"loss": 8, "steps": 9},
    }
    assert json.dumps(renamed.under_new_names(old, NAMES)) == json.dumps(
        {
            "train": {"belief": {"filter": {"width_std": 1, "gain": 2}, "n_steps": 3}, "seed": 4},
            "ilc": {"A": {"inverse": [{"best": 5}]}, "B": {"pixels": 6}},
            "share_at_0.7": 7,
            "panel": {"steps": 9},
            "plant": {"heat": {"loss": 8}},
        }
    )


@pytest.mark.parametrize("table", [renamed.PARAMETERS, renamed.METRICS])
def test_a_new_name_is_nobodys_old_name_so_files_of_today_are_read_as_they_are(table):
    assert [new for new in table.values() if renamed.new_name(new, table) != new] == []


def test_every_new_parameter_and_choice_exists_today(root):
    today = params.read(root / params.FILE)
    new = [*renamed.PARAMETERS.values(), *(key for key, _ in renamed.CHOICES)]
    assert [key for key in new if not has(today, key.split("."))] == []


def test_every_new_metric_exists_today(measured):
    assert [key for key in renamed.METRICS.values() if not has(measured, key.split("."))] == []


def test_every_renamed_column_exists_today_and_its_old_name_does_not():
    for (table, old), new in renamed.COLUMNS.items():
        names = [column.name for column in SCHEMAS[table].columns]
        assert new in names and old not in names, (table, old, new)


# ---- what version 0.1 wrote


def test_every_parameter_of_version_0_1_is_known_today(root):
    today = set(keys(params.read(root / params.FILE)))
    old = renamed.parameters(params.read(OLD / "params.yaml"))
    assert [key for key in keys(old) if key not in today] == []


# tables whose rows are of something else today: a search for each contestant, one candidate a row
OF_SOMETHING_ELSE = {"tuning"}
# and one that nobody writes or reads any more: the cases stand in its place
NO_MORE = {"scorecard"}


def test_every_column_of_version_0_1_is_known_today():
    """A column that is gone for another reason would need another version's reader."""
    for table, names in artifacts.read_json(OLD / "columns.json").items():
        if table in NO_MORE:
            assert table not in SCHEMAS
            continue
        if table in OF_SOMETHING_ELSE:
            assert SCHEMAS[table].version > 2
            continue
        new = renamed.columns(table)
        today = [column.name for column in SCHEMAS[table].columns]
        assert [new.get(name, name) for name in names if new.get(name, name) not in today] == [], table


def test_an_accepted_run_of_version_0_1_is_read_under_todays_names(root, measured):
    run = artifacts.read_accepted(OLD / "accepted.json")
    assert set(keys(run["params"])) <= set(keys(params.read(root / params.FILE)))
    # the old comparison was of other controllers on other plants: history shows it as of its day; what
    # the memo gave in one run is said in its log
    gone = ("evaluate_temperature.controllers", "tune_weights.practical", "ingest.processed", "ingest.reused")
    lost = [key for key in keys(run["metrics"]) if not has(measured, key.split("."))]
    assert [key for key in lost if not key.startswith(gone)] == []
    # no figure is lost or altered on the way
    old = artifacts.read_json(OLD / "accepted.json")
    assert sorted(map(str, leaves(run["metrics"]))) == sorted(map(str, leaves(old["metrics"])))
    assert run["figures"]["window"].keys() == old["figures"]["window"].keys()


def leaves(data):
    children = data.values() if isinstance(data, dict) else data if isinstance(data, list) else None
    if not children:
        return [data]
    return [leaf for child in children for leaf in leaves(child)]


@pytest.mark.parametrize("name", ["scores", "library", "scoreboard"])
def test_a_champions_table_of_version_0_1_is_read_under_todays_names(name):
    # the scoreboard has columns since that nobody had measured
    schema = setpoint.SCOREBOARD_1 if name == "scoreboard" else SCHEMAS[name]
    table = artifacts.read_table(OLD / f"{name}.parquet", schema)
    assert list(table) == [column.name for column in schema.columns]
    assert artifacts.version(OLD / f"{name}.parquet") == schema.version
    assert {column.name for column in schema.columns} <= {column.name for column in SCHEMAS[name].columns}


def test_a_params_file_of_version_0_1_is_told_every_new_name(tmp_path, monkeypatch):
    """By hand: a section that has one renamed key and one that is simply wrong."""
    monkeypatch.setattr(renamed, "PARAMETERS", {"panel.loss": "panel.extra_heat_loss_per_step"})
    monkeypatch.setattr(renamed, "CHOICES", {("panel.law", "ours"): "model_inverse"})

    class Panel(Section):
        extra_heat_loss_per_step: float = Field(ge=0, le=1)
        steps: int = Field(ge=1, le=9)

    path = tmp_path / "params.yaml"
    path.write_text("panel:\n  steps: 600\n")
    (tmp_path / "params.expert.yaml").write_text("panel:\n  loss: 0.005\n  law: ours\n")
    with pytest.raises(ValueError, match="was renamed") as error:
        params.load(Panel, "panel", path)
    lines = str(error.value).replace(f"{tmp_path}/", "").splitlines()
    assert lines[0] == "params.expert.yaml: panel.loss was renamed to panel.extra_heat_loss_per_step"
    assert "params.yaml: panel.steps is 600 but must be at most 9" in lines
    assert not any("missing" in line for line in lines)
    with pytest.raises(ValueError, match=r"panel.loss was renamed to panel.extra_heat_loss_per_step$"):
        params.value("panel.extra_heat_loss_per_step", path, one_of=(0.0, 0.1))
    with pytest.raises(ValueError, match=r"panel.law is \"ours\" .*; ours was renamed to model_inverse$"):
        params.value("panel.law", path, one_of=("model_inverse", "pixels"))


# ---- tables


BEFORE = Schema("laps", 1, (Column("laps", COUNT, NONE, "laps", low=0),))
TODAY = Schema("laps", 2, (Column("rounds", COUNT, NONE, "rounds", low=0),))


def test_a_table_of_an_earlier_version_is_read_where_only_names_have_changed(tmp_path, monkeypatch):
    path = tmp_path / "laps.parquet"
    artifacts.write_table(path, BEFORE, {"laps": [3, 4]})
    with pytest.raises(ValueError, match="holds schema laps version 1 but laps version 2 is expected"):
        artifacts.read_table(path, TODAY)
    monkeypatch.setattr(renamed, "COLUMNS", {("laps", "laps"): "rounds"})
    assert artifacts.read_table(path, TODAY)["rounds"].tolist() == [3, 4]
    # bounds of today hold for it too, and a column more is another table
    with pytest.raises(ValueError, match="rounds is 4 .* but must be at most 3"):
        artifacts.read_table(path, TODAY._replace(columns=(TODAY.columns[0]._replace(high=3),)))
    more = TODAY._replace(columns=(*TODAY.columns, Column("seconds", COUNT, "s", "time")))
    with pytest.raises(ValueError, match="version 1 but laps version 2 is expected"):
        artifacts.read_table(path, more)


def test_a_table_of_a_later_version_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "laps.parquet"
    artifacts.write_table(path, BEFORE._replace(version=3), {"laps": [3]})
    monkeypatch.setattr(renamed, "COLUMNS", {("laps", "laps"): "rounds"})
    with pytest.raises(ValueError, match="version 3 but laps version 2 is expected"):
        artifacts.read_table(path, TODAY)


def test_the_pages_read_an_accepted_run_and_metrics_of_an_earlier_version(tmp_path, monkeypatch):
    monkeypatch.setattr(renamed, "METRICS", {"train.*.ours": "train.*.inverse"})
    run = {"metrics": {"train": {"A": {"ours": 1}}}, "params": {}, "hashes": {"a": "b"}}
    artifacts.write_json(tmp_path / "accepted.json", run)
    assert artifacts.read_accepted(tmp_path / "accepted.json") == run | {
        "metrics": {"train": {"A": {"inverse": 1}}}
    }
    artifacts.write_json(tmp_path / "train.json", {"A": {"ours": 1}})
    assert artifacts.read_old_metrics(tmp_path / "train.json") == {"A": {"inverse": 1}}
    shutil.copy(tmp_path / "train.json", tmp_path / "other.json")
    assert artifacts.read_old_metrics(tmp_path / "other.json") == {"A": {"ours": 1}}
