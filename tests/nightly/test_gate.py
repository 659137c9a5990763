"""The night obeys the page: whatever the metrics say, both speak of one verdict, and only what passes is put
in production; the rest is a candidate."""

import contextlib
import html
import json
import re
from pathlib import Path

import numpy as np
import pytest

from pipeline.cli import render_night
from pipeline.deposition.tables import SCORES
from pipeline.nightly import champion, judge, night, promoting, reporting, reproducing, screening
from pipeline.nightly.decision import CaseCosts
from pipeline.nightly.records import CANDIDATE, FIRST, KEPT, PROMOTED, Champion, ChampionState, Night
from pipeline.nightly.settings import Nightly
from pipeline.report.index import page as index_page
from pipeline.report.nightly import page as nightly_page
from pipeline.report.shared.sources import Declared, Sources, collect
from pipeline.report.temperature.judgement import judgement
from pipeline.store import artifacts, params
from pipeline.temperature.settings import Plant
from pipeline.verdict.digits import typeset
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import FAILED, OPEN, PASSED, Verdict
from stages import report
from stages import verdict as stage_verdict
from tests.conftest import ROOT
from tests.nightly.toy_nights import Project, entered
from tests.report import made, made_certificate, made_setpoint
from tests.report.conftest import populate

LOOPS = {
    "temperature": ["datasets/identify_plant/plant.parquet", "datasets/tune_weights/weights.json"],
    "deposition": ["datasets/segment_library/library.parquet"],
    "setpoint": ["datasets/train_classifier/windows.parquet"],
}
ABSENT = "absent"  # nothing was judged, and so everything is open
WHEN = "2030-01-09T02:00:00+00:00"
NIGHTLY = "reports/metrics/nightly.json"


def make_tonight() -> Night:
    return Night(7, "night-0007", WHEN, seconds=1.0)


@pytest.fixture(scope="module")
def passing(tmp_path_factory):
    """A folder with every artifact that the pages show, all loops passing; what each of its files holds."""
    folder = tmp_path_factory.mktemp("passing")
    with contextlib.chdir(folder):
        populate(folder)
        stage_verdict.main()
    return folder, {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def project(passing, monkeypatch):
    """That folder as the working directory, as it was made. Nothing is copied to champion/, and no contestant
    is played: what a challenger costs is half of what a champion does."""
    folder, files = passing
    monkeypatch.chdir(folder)
    for path in {path for path in folder.rglob("*") if path.is_file()} - files.keys():
        path.unlink()
    for path, content in files.items():
        if not path.exists() or path.stat().st_size != len(content) or path.read_bytes() != content:
            path.write_bytes(content)

    def measure(folder, contestant=""):
        cost = 2.0 if Path(folder).parts[0] == "champion" else 1.0
        return CaseCosts("panel", {f"case {k}": (f"plant {k}", cost) for k in range(8)}, {"worst_case": cost})

    monkeypatch.setattr(judge, "judge", lambda *_: judge.Judge(measure, lambda _: {"worst_case": 0.1}))
    monkeypatch.setattr(screening, "reference", lambda *_: None)
    monkeypatch.setattr(champion, "remove", lambda _: None)
    monkeypatch.setattr(champion, "hand_over", lambda _, files, __: ({"md5": "0"}, md5s(files)))
    return folder


def md5s(files) -> dict[str, str]:
    return {name.removeprefix("datasets/"): champion.md5_of(name) for name in files}


def settings(**holdout) -> Nightly:
    declared = params.load(Nightly, "nightly", ROOT / "params.yaml")
    loops = {
        name: loop.model_copy(update={"artifacts": LOOPS[name]}) for name, loop in declared.loops.items()
    }
    changed = {"loops": loops, "holdout": declared.holdout.model_copy(update=holdout)}
    return declared.model_copy(update=changed)


def other(run="night-0003") -> Champion:
    """A champion or a candidate with other files."""
    return Champion(run, WHEN, "", {"md5": "1"}, {"weights.json": "1"})


# ---- metrics files: each rule passed, exactly at its limit, undecided, failed, open


def contestants(stages):
    compared = stages["evaluate_temperature"]["contestants"]
    return [compared[name] for name in compared if name not in ("hold", "exact_model")]


def banded(key, limit):
    """A figure of every contestant: inside its limit, at it, across it, beyond it, endless, missing."""

    def to(value, low, high):
        return lambda stages: [
            one.update({key: made.figure(value, low, high)}) for one in contestants(stages)
        ]

    return [
        (PASSED, to(0.5 * limit, 0.4 * limit, 0.6 * limit)),
        (PASSED, to(0.9 * limit, 0.8 * limit, limit)),
        (OPEN, to(limit, 0.9 * limit, 1.1 * limit)),
        (FAILED, to(1.2 * limit, 1.1 * limit, 1.3 * limit)),
        (FAILED, to(1e24, 1e23, 1e25)),
        (FAILED, to(None, None, None)),
        (OPEN, lambda stages: [one.pop(key, None) for one in contestants(stages)]),
    ]


def margin(key, least):
    def to(value):
        return lambda stages: [one["margins"].update({key: value}) for one in contestants(stages)]

    at = [(PASSED, 2.0 * least), (PASSED, least), (FAILED, np.nextafter(least, 0)), (FAILED, 0.0)]
    return [
        *((state, to({"q10": value, "worst": 0.5 * value})) for state, value in at),
        (OPEN, lambda stages: [one["margins"].pop(key, None) for one in contestants(stages)]),
    ]


def counted(cases):
    return lambda stages: [one.update(crossings={"cases": cases, "of": 24}) for one in contestants(stages)]


def drift(key):
    alarm = {"loop": "temperature", "key": "k", "recording": "a.csv", "cause": "the gain fell", "sigmas": 9.0}
    written = {"alarms": [], "watched": [], "figures": {}} | ({key: [alarm]} if key else {})
    return lambda _: artifacts.write_json(NIGHTLY, {"run": "night-0006", "when": "", "drift": written})


def temperature(rules: ReportRules):
    return [
        banded("settled_error", rules.settled_error_degC),
        banded("peak", rules.peak_error_degC),
        banded("settling", 60.0),
        banded("overshoot", rules.overshoot_degC),
        banded("at_limits", rules.at_limits_percent),
        margin("disk", rules.disk_margin),
        margin("delay_s", rules.delay_margin_s),
        [(PASSED, counted(0)), (FAILED, counted(1)), (OPEN, counted(None))],
        [(FAILED, lambda stages: [one.update(stable={"count": 5, "of": 6}) for one in contestants(stages)])],
        [(ABSENT, lambda stages: stages.pop("evaluate_temperature"))],
        [(PASSED, drift("")), (PASSED, drift("watched")), (FAILED, drift("alarms"))],
    ]


def deposition(rules: ReportRules):
    whole = 1.5

    def scores(**changed):
        ours = {"error": 2.0, "line": 1.0, "whole": whole} | changed
        rows = [
            ("square", "A", "on_off", False, 100.0, None, 60.0),
            ("square", "A", "priority", False, 50.0, 11.0, 9.0),
            ("square", "A", "basis", True, ours["error"], 2.5, ours["line"]),
            ("square", "A", "ilc", False, ours["whole"], None, 0.5),
        ]
        table = made._columns(SCORES, rows if ours["whole"] else rows[:-1])
        return lambda _: artifacts.write_table("datasets/compose_parts/scores.parquet", SCORES, table)

    def learned(ratio):
        return lambda stages: stages["train_ilc"]["A"]["pixels"].update(last_ratio=ratio, best_ratio=ratio)

    def conformance(**changed):
        path = "datasets/compose_parts/conformance.json"
        said = json.loads(Path(path).read_text())
        return lambda _: artifacts.write_json(path, {"square": said["square"] | changed})

    untold = {"low": 0.4, "high": 3.1, "judged": False, "reason": "too fast", "trial": "train it"}
    unjudged = {"A": untold | {"composers": {}}}
    most, line, above = rules.flow_error_percent, rules.line_volume_percent, rules.above_whole_points
    return [
        [
            (PASSED, scores(error=most, whole=most)),
            (FAILED, scores(error=np.nextafter(most, 99), whole=most)),
            (PASSED, scores(line=line)),
            (FAILED, scores(line=np.nextafter(line, 99))),
            (OPEN, scores(line=np.nan)),
            (PASSED, scores(whole=2.0 - above)),
            (FAILED, scores(whole=1.99 - above)),
            (OPEN, scores(whole=None)),
        ],
        [
            (PASSED, learned(0.01 * rules.learned_percent)),
            (FAILED, learned(0.3)),
            (FAILED, learned(1e24)),
            (OPEN, lambda stages: stages.pop("train_ilc")),
        ],
        [
            (PASSED, conformance(refused=[])),
            (FAILED, conformance(refused=[{"line": 7, "why": "no such word"}])),
            (OPEN, conformance(forecast=unjudged)),
        ],
        [(ABSENT, lambda _: Path("datasets/compose_parts/scores.parquet").unlink())],
    ]


def setpoint(rules: ReportRules):
    def lost(percent, runs=made_setpoint.RUNS):
        return lambda _: made_setpoint.scoreboard({made_setpoint.DEFAULT: (percent, 0.0)}, runs)

    def image(percent, low, high):
        def change(stages):
            seen = stages["train_classifier"]
            seen["image_accuracy"] = percent / 100
            seen["intervals_percent"]["image"] = [low, high]

        return change

    def error(key, value):
        return lambda stages: stages["train_classifier"].update({key: value})

    least = 100 * rules.image_accuracy
    return [
        [(PASSED, lost(0.1)), (FAILED, lost(20.0)), (OPEN, lost(2.0, 50))],
        [
            (PASSED, image(least + 2, least, least + 4)),
            (OPEN, image(least + 1, least - 1, least + 3)),
            (FAILED, image(least - 2, least - 3, least - 0.5)),
        ],
        [(PASSED, error("ece_image", rules.ece_image)), (FAILED, error("ece_image", 0.2))],
        [(PASSED, error("ece_window", rules.ece_window)), (OPEN, error("ece_window", None))],
        [(ABSENT, lambda _: Path("datasets/evaluate_setpoint/choice.json").unlink())],
    ]


def worst(states) -> str:
    return OPEN if ABSENT in states else next((state for state in (FAILED, OPEN) if state in states), PASSED)


def written(rng) -> dict[str, str]:
    """Metrics files with none to two rules of each loop changed; the state that each loop has by them."""
    rules = params.load(ReportRules, "report", ROOT / "params.yaml")
    stages = made.metrics() | made.deposition_metrics() | made_setpoint.metrics()
    expected = {}
    for loop, each in (("temperature", temperature), ("deposition", deposition), ("setpoint", setpoint)):
        asked = each(rules)
        chosen = rng.choice(len(asked), rng.choice([0, 1, 1, 2]), replace=False)
        changes = [asked[k][rng.integers(len(asked[k]))] for k in sorted(chosen)]
        for _, change in changes:
            if "evaluate_temperature" in stages or loop != "temperature":
                change(stages)
        expected[loop] = worst([state for state, _ in changes])
    for stage in (*made.metrics(), *made.deposition_metrics(), *made_setpoint.metrics()):
        Path(f"datasets/{stage}/figures.json").unlink(missing_ok=True)
    for stage, figures in stages.items():
        artifacts.write_metrics(stage, figures)
    stage_verdict.main()
    return expected


def words(page: str) -> str:
    """What a page says, without its tags, styles and scripts."""
    body = re.sub(r"<(style|script).*?</\1>", "", page, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", "", body)).replace("\u202f", " ").split())


def said(text: str) -> str:
    return " ".join(typeset(text).replace("\u202f", " ").split())


def section(page: str, loop: str) -> str:
    """What nightly.html says of one loop."""
    after = page.split(f'px">{loop}: ')[1]
    return words(re.split(r"<h3|</section>", after)[0])


@pytest.mark.parametrize("seed", range(100))
def test_page_and_night_never_disagree(project, seed):
    rng = np.random.default_rng([18, seed])
    expected, asked = written(rng), settings()
    before = ChampionState(
        {loop: other() for loop in LOOPS if rng.random() < 0.5},
        candidates={loop: other("night-0005") for loop in LOOPS if rng.random() < 0.5},
    )
    tonight = make_tonight()
    after = promoting.judge_all(asked, tonight, before, {})
    sources = page_sources()
    index = words(index_page.render(sources, judgement(sources)))
    page = nightly_page.render([tonight], after, asked)
    summary = reporting.summarise(tonight, [])
    assert {loop: tonight.decisions[loop].verdict.state for loop in LOOPS} == expected
    for loop, decision in tonight.decisions.items():
        verdict, passed = decision.verdict, expected[loop] == PASSED
        promotes = PROMOTED if loop in before.champions else FIRST
        # the night promotes what the page passes, and nothing else
        assert decision.decision == (promotes if passed else CANDIDATE), (loop, decision)
        assert (loop in after.candidates) == (not passed)
        assert (loop in tonight.promoted) == passed
        # one sentence, on both pages
        assert said(verdict.decision) in index and said(verdict.lead) in index
        mine = section(page, loop)
        assert said(verdict.sentence) in mine
        # and none that contradicts it
        assert verdict.decision.startswith("Pass (simulation)") == passed
        assert (f"candidate {loop}: {verdict.sentence}" in summary) == (not passed)
        assert ("Pass (simulation)" in mine) == passed and ("Fail (simulation)" in mine) == (
            expected[loop] == FAILED
        )
        assert (f"candidate of {loop}, not run" in words(page)) == (not passed)
        assert re.search(rf"Promoted: [^.]*\b{loop}", words(page)) is None or passed
        kept = after.champions.get(loop) if not passed else None
        assert kept == (before.champions.get(loop) if not passed else None)
        mine_in_production = after.champions[loop] if passed else after.candidates[loop]
        assert mine_in_production.rehearsal and mine_in_production.contestant == verdict.subject
        assert mine_in_production.verdict == verdict.sentence
    head = re.search(r"(?:Pass|Fail|Undecided) \(simulation\): .*?\.", index)
    passed = sorted(loop for loop, state in expected.items() if state == PASSED)
    first = head[0] if head else ""
    named = re.search(r"Pass \(simulation\): (.*?)[;.]", first)
    listed = (
        list(LOOPS)
        if named and "all three loops" in named[1]
        else [loop for loop in LOOPS if named and loop in named[1]]
    )
    assert sorted(listed) == passed, (first, expected)
    assert not re.search(r"\d{7,} ?%|e\+?\d+ ?%", words(page) + summary)


CERTIFYING = """stages:
  export_controllers:
    cmd: python -m stages.export_controllers
    outs: [datasets/export_controllers: {persist: true}]
"""


@pytest.mark.parametrize(
    ("refused", "controller", "there", "why"),
    [
        ("", "subspace_lqg", True, ""),
        ("disk_margin", "subspace_lqg", True, "certificate refused by its rule disk margin"),
        ("", "pi", True, "that of export_controllers is of pi, not of subspace_lqg"),
        ("", "subspace_lqg", False, "export_controllers wrote none of subspace_lqg"),
    ],
)
def test_a_champion_of_the_heaters_has_a_passed_certificate_of_its_own(
    project, refused, controller, there, why
):
    """Where the project has the stage that certifies: what passes the page's rules alone is a candidate."""
    path = Path(promoting.CERTIFICATE)
    artifacts.write_json(path, made_certificate.certificate(refused) | {"controller": controller})
    if not there:
        path.unlink()
    for name in promoting.CERTIFIED[:2]:
        Path(name).write_text("whole")
    Path("dvc.yaml").write_text(CERTIFYING)
    asked = settings()
    tonight = make_tonight()
    after = promoting.judge_all(asked, tonight, ChampionState(), {})
    Path("dvc.yaml").unlink()
    decision = tonight.decisions["temperature"]
    assert decision.verdict.state == PASSED and decision.promotes == (not why)
    assert why in " ".join(decision.reasons)
    assert ("temperature" in after.candidates) == bool(why)
    page = words(nightly_page.render([tonight], after, asked))
    assert why in page
    # a refused one's certificate lies beside the candidate all the same; the other loops ask for none
    assert all(tonight.decisions[loop].promotes for loop in LOOPS if loop != "temperature")


def page_sources() -> Sources:
    """What the stage `report` reads."""
    declared = Declared(params.load(ReportRules, "report"), params.load(Plant, "plant"), params.read())
    return collect(declared, report.FIGURES, report.FOLDERS, "reports/accepted.json", ())


@pytest.mark.parametrize("key", ["", "watched", "alarms"])
def test_the_night_goes_by_the_verdicts_that_the_pages_show(project, key):
    drift(key)(None)
    by_loop = promoting.read_verdicts(settings(), make_tonight())
    assert by_loop == page_sources().verdicts and by_loop.keys() == LOOPS.keys()


def test_a_loop_whose_verdict_is_missing_is_never_promoted(project):
    Path("datasets/verdict/deposition.json").unlink()
    with pytest.raises(ValueError, match=r"^datasets/verdict/deposition\.json: expected the verdict"):
        promoting.read_verdicts(settings(), make_tonight())


def test_the_report_keeps_the_verdicts_of_the_night_and_is_made_anew_if_they_have_changed(
    project, monkeypatch
):
    made.main()
    made_anew = []

    def repro(*command, **_):
        made_anew.append(command)
        if len(made_anew) > 1:
            raise ValueError("dvc repro failed: no room")

    monkeypatch.setattr(promoting, "dvc", repro)
    tonight = make_tonight()
    by_loop = promoting.read_verdicts(settings(), tonight)
    kept = artifacts.read_figures("report")
    assert kept["verdicts"] == {loop: verdict.metrics() for loop, verdict in by_loop.items()}
    assert kept["verdict"] == by_loop["temperature"].metrics()
    assert made_anew == [] and tonight == make_tonight()
    # the drift that they were made with is over since: they are made anew, so that both say the same
    drift("alarms")(None)
    for _ in range(2):
        assert promoting.read_verdicts(settings(), tonight)["temperature"].state == FAILED
    assert made_anew == 2 * [("repro", "--single-item", "--force", "report")]
    assert tonight.notes == [
        "the pages are not of tonight (dvc repro failed: no room); run ./run dvc repro --force report"
    ]


def test_a_contestant_that_is_named_to_run_must_pass_itself(project):
    stages = made.metrics()
    own = stages["evaluate_temperature"]["contestants"]["varx_riccati"]
    assert promoting.read_verdicts(settings(controller="varx_riccati"), make_tonight())[
        "temperature"
    ].winner == ("varx_riccati")
    own["overshoot"] = made.figure(9.0, 8.0, 10.0)
    artifacts.write_metrics("evaluate_temperature", stages["evaluate_temperature"])
    stage_verdict.main()
    by_page, named = (
        promoting.read_verdicts(settings(controller=name), make_tonight())["temperature"]
        for name in ("page", "varx_riccati")
    )
    assert (by_page.state, by_page.winner) == (PASSED, "subspace_lqg")
    assert named.state == FAILED and named.subject == "varx_riccati" and named.winner is None
    assert named.sentence == "Fail (simulation). First failed rule: overshoot."
    assert "VARX + Riccati is named to run, and does not pass." in named.reason
    tonight = make_tonight()
    after = promoting.judge_all(settings(controller="varx_riccati"), tonight, ChampionState(), {})
    assert tonight.decisions["temperature"].decision == CANDIDATE
    assert after.candidates["temperature"].contestant == "varx_riccati"
    # one that was not judged at all is open
    lost = promoting.read_verdicts(settings(controller="printer_pid"), make_tonight())["temperature"]
    assert lost.state == OPEN and lost.subject == "printer_pid" and "was not judged" in lost.reason


def test_what_runs_stays_where_the_page_finds_nobody_better_beyond_the_bands(project):
    """The page's incumbent is the champion's contestant, where there is one."""
    assert promoting.read_verdicts(settings(), make_tonight())["temperature"].winner == "subspace_lqg"
    present = other()._replace(contestant="varx_riccati")
    state = ChampionState({"temperature": present})
    artifacts.write_json(NIGHTLY, make_tonight().metrics(state))
    tonight = make_tonight()
    after = promoting.judge_all(settings(), tonight, state, {})
    assert tonight.decisions["temperature"].verdict.winner == "varx_riccati"
    assert after.champions["temperature"].contestant == "varx_riccati"


def test_the_champion_and_the_challenger_are_each_judged_as_their_own_contestant(project, monkeypatch):
    asked = []

    def measure(folder, contestant=""):
        asked.append((str(folder), contestant))
        return CaseCosts("panel", {f"case {k}": (f"plant {k}", 1.0) for k in range(8)}, {"worst_case": 1.0})

    monkeypatch.setattr(judge, "judge", lambda *_: judge.Judge(measure, lambda _: {}))
    verdict = promoting.read_verdicts(settings(), make_tonight())["temperature"]
    state = ChampionState({"temperature": other()._replace(contestant="pi_simc")})
    promoting.judge_loop(settings(), "temperature", make_tonight(), state, verdict)
    assert asked == [("datasets", "subspace_lqg"), ("champion/temperature", "pi_simc")]


def test_the_same_files_as_another_contestant_are_another_challenger(project):
    verdict = promoting.read_verdicts(settings(), make_tonight())["temperature"]
    files = md5s(LOOPS["temperature"])
    decisions = {
        contestant: promoting.judge_loop(
            settings(),
            "temperature",
            make_tonight(),
            ChampionState({"temperature": other()._replace(files=files, contestant=contestant)}),
            said,
        )
        for contestant, said in (
            ("subspace_lqg", verdict),
            ("pi_simc", verdict),
            (
                "pi",
                verdict._replace(state=FAILED, decision="Fail (simulation).", lead="First failed rule: x."),
            ),
        )
    }
    assert [one.decision for one in decisions.values()] == [KEPT, PROMOTED, KEPT]
    assert decisions["subspace_lqg"].reasons == ["the challenger is the champion, byte for byte"]
    assert decisions["pi"].reasons == [
        "the challenger is the champion, byte for byte, which does not pass: "
        "Fail (simulation). First failed rule: x."
    ]


def test_a_champion_that_would_lack_what_it_is_designed_from_is_not_promoted(project):
    verdict = promoting.read_verdicts(settings(), make_tonight())["temperature"]._replace(subject="pi_simc")
    decided = promoting.judge_loop(settings(), "temperature", make_tonight(), ChampionState(), verdict)
    assert decided.decision == KEPT and decided.reasons == [
        "pi_simc is designed from datasets/identify_plant/spread.parquet, which the champion would lack; add "
        "it to nightly.loops.temperature.artifacts"
    ]


def test_the_artifacts_hold_what_every_contestant_is_designed_from():
    artifacts_of = set(params.load(Nightly, "nightly", ROOT / "params.yaml").loops["temperature"].artifacts)
    assert promoting.OPTIONAL <= artifacts_of
    # of these, a record may not determine some
    loop = params.load(Nightly, "nightly", ROOT / "params.yaml").loops["temperature"]
    assert set(loop.artifacts) - set(promoting.list_files(loop)) == {
        path for path in promoting.OPTIONAL if not Path(path).is_file()
    }


# ---- in a repository


@pytest.fixture
def played(tmp_path, monkeypatch):
    """A repository with one loop, whose page says what the test says."""
    Project(tmp_path / "empty").make()
    entered(Project(tmp_path / "empty"), tmp_path / "toy", monkeypatch)
    Path("dvc.lock").write_text("schema: '2.0'\nstages: {}\n")
    copy = Project(tmp_path / "toy")
    own = {"judge": "deposition", "cases": "", "recordings": "", "artifacts": ["datasets/compose_parts/x"]}
    copy.set(loops={"deposition": own})
    evidence = CaseCosts("panel", {f"case {k}": (f"part {k}", 1.0) for k in range(8)}, {"worst": np.inf})
    monkeypatch.setattr(judge, "judge", lambda *_: judge.Judge(lambda *_: evidence, lambda _: {"worst": 1.0}))
    monkeypatch.setattr(screening, "reference", lambda *_: None)
    return copy


def test_a_candidate_is_kept_beside_the_champions_until_a_challenger_passes(played, monkeypatch):
    words_of = {
        FAILED: ("Fail (simulation).", "First failed rule: flow error."),
        PASSED: ("Pass (simulation): the basis functions.", "All six rules passed."),
    }

    def a_night(number, files, state):
        artifact = Path("datasets/compose_parts/x")

        def reproduce(_, log, **__):
            # the pages that the stages make show the drift of this very night
            assert artifacts.read_json(NIGHTLY)["run"] == log.stem == f"night-{number:04d}"
            artifact.parent.mkdir(parents=True, exist_ok=True)
            artifact.write_text(files)
            return {}, []

        monkeypatch.setattr(reproducing, "reproduce", reproduce)
        verdict = Verdict("deposition", state, *words_of[state], "", "", "", "basis", subject="basis")
        verdict = verdict._replace(rehearsal=True)
        monkeypatch.setattr(promoting, "read_verdicts", lambda settings, night: {"deposition": verdict})
        Path("learn.py").write_text(f"# night {number}\n")
        status, summary = night.nightly(render_night)
        assert status == reporting.OK, summary
        return summary, json.loads(played.run("git", "show", "HEAD:champion.json").stdout)

    summary, state = a_night(1, "one", FAILED)
    assert "candidate deposition: Fail (simulation). First failed rule: flow error." in summary
    assert "promoted" not in summary
    candidate = state["candidates"]["deposition"]
    assert not state["champions"] and not state["history"]
    assert candidate["run"] == "night-0001" and candidate["files"]
    assert (candidate["contestant"], candidate["rehearsal"]) == ("basis", True)
    assert candidate["why"] == candidate["verdict"] == "Fail (simulation). First failed rule: flow error."
    assert candidate["lineage"]["uncommitted"] == ["learn.py", "params.yaml"]
    assert played.production_of("deposition.candidate") == {"compose_parts/x": b"one"}
    # the same challenger again stays the candidate of the night that made it, and its files are as they were
    before = played.head()
    _, state = a_night(2, "one", FAILED)
    assert played.head() == before  # nothing moved, and nothing is committed
    assert state["candidates"]["deposition"]["run"] == "night-0001"
    # the next one takes its place
    _, state = a_night(3, "two", FAILED)
    assert state["candidates"]["deposition"]["run"] == "night-0003"
    assert played.production_of("deposition.candidate") == {"compose_parts/x": b"two"}
    # the folder follows what the last commit says
    Path("champion/deposition.candidate/compose_parts/x").write_text("half")
    assert champion.follow() == ["champion/deposition.candidate is that of night-0003"]
    assert played.production_of("deposition.candidate") == {"compose_parts/x": b"two"}
    summary, state = a_night(4, "two", PASSED)
    assert "promoted deposition" in summary and "candidate" not in summary
    assert state["candidates"] == {} and state["champions"]["deposition"]["rehearsal"]
    assert state["champions"]["deposition"]["contestant"] == "basis"
    assert played.production_of("deposition") == {"compose_parts/x": b"two"}
    assert not Path("champion/deposition.candidate").exists()
    tracked = played.run("git", "ls-files", "champion").stdout.split()
    assert tracked == ["champion/.gitignore", "champion/deposition.dvc"]
    # a challenger that does not pass leaves the champion alone
    summary, state = a_night(5, "three", FAILED)
    assert state["champions"]["deposition"]["run"] == "night-0004"
    assert state["candidates"]["deposition"]["run"] == "night-0005"
    assert played.production_of("deposition") == {"compose_parts/x": b"two"}
    page = words(Path("reports/nightly.html").read_text())
    assert "Nothing is promoted: deposition does not pass." in page and "Fail (simulation)." in page
    assert champion.follow() == []
    assert not [line for line in played.dirty() if "champion" in line]
