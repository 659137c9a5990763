"""The summary of the benchmarks says what their results say beside the goals that were set, the README and
the page say the same, and what measures stages and growth measures them."""

import importlib.util
import json
import os
import subprocess

import numpy as np
import pytest
import yaml

from benchmarks import branches, gcode, growth, reading_speed, stages, summary, summary_page, trial_frames
from benchmarks.__main__ import chosen, lacks, machine, ran
from benchmarks.summary import BENCHMARKS, Benchmark
from pipeline.store import artifacts

# as they were set, before anything was measured
SET = {
    "kernel": (60, "at least"), "agent_products": (0.85, "at least"), "agent_loop": (4, "at least"),
    "frames": (2500, "at least"), "transformer": (0.9, "at least"), "identification": (2, "at least"),
    "identification_none": (10, "at least"), "compose": (2, "at most"), "compose_memory": (250, "at most"),
    "compose_million": (600, "at most"), "csv": (1.5, "at most"), "temperature": (80, "at most"),
    "deposition": (60, "at most"), "setpoint": (130, "at most"), "pages": (30, "at most"),
    "whole": (300, "at most"), "quick": (120, "at most"), "nothing": (3.5, "at most"),
    "one_more": (8, "at most"), "peak": (2000, "at most"),
}  # fmt: skip


@pytest.fixture
def results(tmp_path):
    """results(csv={...}): an empty folder of results with these files."""

    def put(**files):
        for name, data in files.items():
            (tmp_path / f"{name}.json").write_text(json.dumps(data))
        return tmp_path

    return put


def figure(gathered, key):
    return (gathered["hot_paths"] | gathered["default_run"])[key]


# ---- what the summary says


def test_the_goals_are_those_that_were_set():
    assert {g.key: (g.goal, g.side) for g in summary.GOALS if g.goal is not None} == SET
    assert (summary.MUTANTS_GOAL, summary.BRANCHES_GOAL, summary.EXPONENT_GOAL) == (0.9, 0.92, 1.1)
    # and no benchmark judges itself by another
    assert gcode.BARS["compose_65k_s"] == SET["compose"][0]
    assert gcode.BARS["compose_65k_mb"] == SET["compose_memory"][0]
    assert gcode.BARS["million_lines_mb"] == SET["compose_million"][0]
    assert reading_speed.BARS["csv"] == SET["csv"][0] and trial_frames.BARS["raw"] == SET["frames"][0]
    assert growth.LIMIT == summary.EXPONENT_GOAL


def test_where_there_is_no_result_everything_reads_not_measured_and_nothing_is_met(results):
    gathered = summary.gathered(results())
    for goal in summary.GOALS:
        one = figure(gathered, goal.key)
        assert (one["value"], one["met"], one["machine"], one["why"]) == (None, None, None, "not measured")
    tables = [gathered[name] for name in ("stages", "growth", *summary.ENDURANCE)]
    assert all(table["why"] == "not measured" and table["command"] for table in tables)
    rows = [line for line in summary.block(gathered).splitlines() if line.startswith("| ")]
    told = [row.split(" | ") for row in rows[1:]]
    assert len(told) == len(summary.GOALS)
    assert all(cells[1] == "not measured" and cells[3] == " |" for cells in told), told
    assert summary_page.render(gathered).count("not measured") >= len(summary.GOALS)


@pytest.mark.parametrize(
    ("key", "file", "data"),
    [
        ("csv", "reading_speed", lambda x: {"csv": {"ratio": x}}),
        ("kernel", "kernel", lambda x: {"figures": [{"value": x}]}),
        ("whole", "stages", lambda x: {"whole_s": x}),
        ("agent_loop", "agent", lambda x: {"peer": {"ratio_whole_loop_s": x}}),
    ],
)
def test_a_goal_is_met_at_its_limit_and_missed_beyond_it(results, key, file, data):
    goal, side = SET[key]
    beyond = goal * (0.99 if side == "at least" else 1.01)
    for value, met, word in ((goal, True, "met"), (beyond, False, "missed")):
        gathered = summary.gathered(results(**{file: data(value)}))
        one = figure(gathered, key)
        assert one["value"] == pytest.approx(value, rel=1e-3) and one["met"] is met
        row = next(
            line for line in summary.block(gathered).splitlines() if line.startswith(f"| {one['what']} |")
        )
        assert row.endswith(f"| {word} |")


def test_a_figure_that_is_no_number_is_not_measured(results):
    gathered = summary.gathered(results(reading_speed={"csv": {"ratio": float("nan")}}, agent={"peer": {}}))
    assert figure(gathered, "csv")["value"] is None and figure(gathered, "agent_loop")["value"] is None


def test_a_machine_is_named_only_beside_what_was_measured_on_it(results):
    data = {"csv": {"ratio": 1.0}}
    folder = results(reading_speed=data)
    runs = {"reading_speed": {"machine": {"cpu": "a CPU", "cores": 2}, "digest": summary.digest(data["csv"])}}
    gathered = summary.gathered(folder, runs)
    assert figure(gathered, "csv")["machine"] == {"cpu": "a CPU", "cores": 2}
    assert summary.machines(gathered) == "Measured on a CPU, 2 cores."
    other = summary.gathered(results(reading_speed={"csv": {"ratio": 1.1}}), runs)
    assert figure(other, "csv")["machine"] is None
    assert summary.machines(other) == "On which machine is not recorded."


def test_kills_fuzzing_and_mutants_are_met_only_where_nothing_slipped_through(results):
    mutants = {"kernel": {"mutants": 60, "killed": 58, "equivalent": 1, "share_killed": 0.983}}
    fuzz = {
        "hours": 1,
        "seeds": [1, 2],
        "files": {"CSV": {"read": 3, "refused": 4}},
        "tracebacks": 0,
        "hangs": 0,
    }
    kills = {"kills": 50, "whole_tree": 20, "stages_made": 13, "files": 90, "repros": 9, "seed": 1,
             "repros_with_the_same_bytes": 9}  # fmt: skip
    good = summary.gathered(results(mutants=mutants, fuzz=fuzz, killed_repros=kills))
    assert all(good[name]["met"] is True for name in ("mutants", "fuzz", "killed_repros"))
    assert good["fuzz"]["files"] == 7
    mutants["gcode"] = mutants["kernel"] | {"share_killed": 0.89}
    bad = summary.gathered(
        results(
            mutants=mutants, fuzz=fuzz | {"hangs": 1}, killed_repros=kills | {"repros_with_the_same_bytes": 8}
        )
    )
    assert all(bad[name]["met"] is False for name in ("mutants", "fuzz", "killed_repros"))
    few = summary.gathered(results(killed_repros=kills | {"kills": 49}))
    assert few["killed_repros"]["met"] is False
    taken = {"branches": 100, "taken": 92, "share_taken": 0.92}
    assert summary.gathered(results(branches=taken))["branches"]["met"] is True
    assert summary.gathered(results(branches=taken | {"share_taken": 0.9199}))["branches"]["met"] is False
    short = summary.gathered(results(fuzz=fuzz | {"hours": 0.5}))
    assert short["fuzz"]["met"] is False


def test_what_a_larger_house_takes_is_reckoned_from_the_rates(results):
    rows = [{"stage": "ingest", "loop": "temperature", "cpu_s": 36.0, "wall_s": 20.0}]
    told = summary.scale(
        results(
            reading_speed={"csv_checked": {"MB": 200.0, "ours_s": 2.0}},
            trial_frames={"raw": {"MB": 90.0, "measured_per_s": 900.0}},
            stages={"stages": rows},
        )
    )
    # 100 GB at 100 MB/s are 1,000 s; raw frames at 90 MB in 0.5 s; 1,000 times 36 s are 10 h
    assert told["core_h_a_day"] == {"csv": 0.278, "raw frames": 0.154, "JPEG frames": None}
    assert told["machines_core_h"] == {"temperature": 10.0, "deposition": None, "setpoint": None}
    sentences = summary.scale_sentences(told)
    assert "100 GB a day, read and checked as csv: 16.7 min of one core (100 MB/s)." in sentences
    assert any(
        "temperature loop every night: 10.0 h of one core, 2 cores for 8 h." in one for one in sentences
    )


def test_the_record_the_page_and_the_readme_say_what_the_results_say(root):
    stored = artifacts.read_json(summary.FILE)
    anew = summary.gathered(summary.RESULTS, stored["runs"])
    do = "run ./run python -m benchmarks --gather, which writes them"
    assert json.loads(json.dumps(anew)) == stored, do
    assert summary.FILE.with_suffix(".html").read_text(encoding="utf-8") == summary_page.render(stored), do
    readme = (root / "README.md").read_text(encoding="utf-8")
    assert summary.in_readme(readme, summary.block(stored)) == readme, do


def test_a_readme_without_a_place_for_the_table_is_refused():
    with pytest.raises(ValueError, match="README.md: expected the lines .*; put them back"):
        summary.in_readme("# beadline\n", "table")


# ---- which benchmarks run


def test_every_benchmark_is_a_module_that_tells_its_command():
    for name, one in BENCHMARKS.items():
        module = importlib.util.find_spec(one.arguments[0])
        assert module and module.origin, name
        with open(module.origin, encoding="utf-8") as stream:
            assert f"python -m {one.arguments[0]}" in stream.read(4000), name
    assert sum(one.minutes for one in BENCHMARKS.values()) <= 25
    assert {goal.benchmark for goal in summary.GOALS} == set(BENCHMARKS) - {"growth"}


def test_a_name_that_is_no_benchmark_is_refused_and_quick_leaves_out_what_takes_long():
    assert chosen(["growth", "kernel"], quick=False) == ["kernel", "growth"]
    assert chosen([], quick=False) == list(BENCHMARKS)
    quick = chosen([], quick=True)
    assert "trial_frames" in quick and not {"kernel", "stages", "growth"} & set(quick)
    with pytest.raises(ValueError, match="--only: kernels is no benchmark; choose among kernel, "):
        chosen(["kernels"], quick=False)


def test_what_is_measured_beside_a_peer_is_left_where_there_is_none(tmp_path):
    assert "stable-baselines3" in lacks(BENCHMARKS["agent_peer"], None)
    assert "stable-baselines3" in lacks(BENCHMARKS["agent_peer"], str(tmp_path / "none"))
    assert lacks(BENCHMARKS["agent_peer"], str(tmp_path)) == lacks(BENCHMARKS["agent"], None) == ""


def test_a_benchmark_that_fails_or_takes_too_long_says_so():
    assert ran(Benchmark(("timeit", "-n", "1", "pass"), "none", "", 1.0), None) == ""
    assert ran(Benchmark(("timeit", "-n", "1", "no_such_name"), "none", "", 1.0), None).startswith(
        "NameError"
    )
    slow = Benchmark(("timeit", "-n", "1", "import time; time.sleep(600)"), "none", "", 2 / 60 / 6)
    assert ran(slow, None) == "took longer than 2 s and was ended"


def test_the_machine_is_named(tmp_path):
    found = machine()
    assert found["cpu"] and found["cores"] >= 1
    # one maker's generations share a name
    told = tmp_path / "cpuinfo"
    first = "processor\t: 0\ncpu family\t: 25\nmodel\t\t: 1\nmodel name\t: A CPU\n"
    told.write_text(f"{first}\n{first.replace(': 1', ': 2')}")
    assert machine(told)["cpu"] == "A CPU (family 25, model 1)"
    told.write_text("Processor\t: 0\n")
    assert machine(told)["cpu"] == os.uname().machine


# ---- growth


def test_the_exponent_of_a_power_is_found_and_its_steepest_step():
    sizes = np.array([10, 100, 1000, 10_000])
    fit = growth.fitted(sizes, 3e-4 * sizes**1.3)
    assert fit.exponent == pytest.approx(1.3) and fit.steepest == pytest.approx(1.3)
    # a start of 1 s hides the slope of the fit, not that of its last step
    late = growth.fitted(sizes, 1.0 + 1e-3 * sizes)
    assert late.exponent < 0.4 and late.steepest > 0.7 and late.steepest_to == 10_000
    with pytest.raises(ValueError, match="expected two sizes or more, found 1"):
        growth.fitted(sizes[:1], sizes[:1])


def test_a_sweep_that_grows_too_fast_is_missed_and_one_of_a_single_size_has_no_exponent(results):
    def points(power):
        return [{"size": n, "cpu_s": 1e-3 * n**power, "above_MB": 0.1 * n} for n in (10, 100, 1000)]

    swept = {name: growth.swept("plants", points(power)) for name, power in (("good", 1.0), ("bad", 1.2))}
    assert swept["good"]["kB_more_a_unit"] == pytest.approx(102, rel=0.01)
    swept["one"] = growth.swept("plants", [*points(1)[:1], {"size": 100, "why": "took longer than 300 s"}])
    gathered = summary.gathered(results(growth=swept))["growth"]
    assert [gathered[name]["met"] for name in swept] == [True, False, None]
    text = "\n".join(summary.growth_lines(gathered))
    assert "| 10 to 1,000 plants | 1.20 | 1.20 | 100 MB | missed |" in text and text.count("met |") == 1
    drawn = summary_page.render(summary.gathered(results(growth=swept)))
    assert drawn.count('<svg class="plot mb"') == 2 and "100: took longer than 300 s" in drawn


def test_a_size_is_timed_with_its_children_and_its_memory(monkeypatch):
    def begin(size, folder):
        code = f"x = bytearray({size}); sum(range(3_000_000))"
        return lambda: subprocess.run(["python", "-c", code], check=True)

    monkeypatch.setitem(growth.SWEEPS, "plants", growth.Sweep("", "", (1,), begin))
    with monkeypatch.context() as once:
        once.setattr(growth, "ENOUGH_S", 0.0)
        assert growth.point("plants", 1000)["cpu_s"] > 0.01  # a child adds three million numbers
    monkeypatch.setitem(
        growth.SWEEPS, "plants", growth.Sweep("", "", (1,), lambda n, _: lambda: bytearray(n))
    )
    monkeypatch.setattr(growth, "children", list)  # other tests' workers live on in this process
    point = growth.point("plants", 80 * 2**20)
    assert 70 < point["above_MB"] < 100  # 80 MB were asked for


@pytest.mark.parametrize(
    "name", ["kernel", "ingestion", "trial", pytest.param("recordings", marks=pytest.mark.slow)]
)
def test_a_sweep_does_its_work_at_its_smallest_size(name, root, monkeypatch):
    monkeypatch.chdir(root)
    monkeypatch.setattr(growth, "ENOUGH_S", 0.0)
    point = growth.point(name, growth.SWEEPS[name].sizes[0])
    assert point["cpu_s"] > 0 and np.isfinite(point["above_MB"])


# ---- stages


def test_a_watcher_notes_what_a_stage_and_its_children_took(tmp_path):
    notes = tmp_path / "notes.jsonl"
    shim = stages.watcher(tmp_path / "bin", notes) / "python"
    child = "import time; x = bytearray(60_000_000); time.sleep(0.8)"
    code = (
        f"import subprocess, sys; one = subprocess.Popen([sys.executable, '-c', {child!r}]); "
        "y = bytearray(60_000_000); sum(range(5_000_000)); one.wait(); sys.exit(3)"
    )
    assert subprocess.run([shim, "-c", code, "stages.toy"]).returncode == 3
    row = json.loads(notes.read_text())
    assert row["stage"] == "toy" and row["wall_s"] >= 0.8 and 0.05 < row["cpu_s"]
    assert 60 < row["largest_process_MB"] < 120 < row["together_MB"]  # two of 60 MB at once


def test_every_stage_counts_for_its_loop_and_the_rest_for_the_pages(root):
    names = yaml.safe_load((root / "dvc.yaml").read_text())["stages"]
    loops = {name: stages.loop_of(name, root) for name in names}
    assert {name for name, loop in loops.items() if not loop} == {"export_controllers", "report"}
    assert (loops["train_ilc"], loops["train_agent"], loops["ingest"]) == (
        "deposition",
        "setpoint",
        "temperature",
    )
    rows = [
        {"loop": "temperature", "wall_s": 3.0},
        {"loop": "", "wall_s": 2.0},
        {"loop": "temperature", "wall_s": 1.0},
    ]
    seconds = stages.by_loop(rows, 10.0)
    assert seconds == {"temperature": 4.0, "deposition": 0.0, "setpoint": 0.0, "pages_and_dvc": 6.0}


def test_branches_not_taken_are_told_by_module():
    def file(branches, taken, missing):
        return {"summary": {"num_branches": branches, "covered_branches": taken}, "missing_branches": missing}

    told = {"files": {"pipeline/a/x.py": file(4, 3, [[7, -5]]), "pipeline/a/y.py": file(6, 5, [[2, 4]]),
                      "pipeline/a/__init__.py": file(0, 0, [])}}  # fmt: skip
    found = branches.table(told)
    assert (found["branches"], found["taken"], found["share_taken"]) == (10, 8, 0.8)
    assert {name: one["not_taken"] for name, one in found["modules"].items()} == {
        "a/x": ["7->end"],
        "a/y": ["2->4"],
    }
