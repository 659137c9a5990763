"""papers.html: for each paper every table, every figure and every number that is a result, printed beside
ours with its verdict; then our data in the papers' axes; the machine of Zavrakli 2023 counted in each way;
and the temperature loop by the length of its record.

All of ours is from files of the second pipeline, datasets/papers/dvc.yaml. Each says at which commit it was
made and whether its method has changed since. No verdict, choice or export reads them.
"""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from pipeline.papers import made
from pipeline.report.papers.figures import pictures
from pipeline.report.papers.rows import FAILS, HOLDS, OPEN, SHAPE, VERDICTS, Paper, read
from pipeline.report.papers.study import ranking
from pipeline.report.shared import page
from pipeline.report.shared.pictures import as_table
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature.pictures import cost_curve, cost_key
from pipeline.store import artifacts
from pipeline.verdict.controllers import BY_NAME
from pipeline.verdict.digits import listed, number
from pipeline.verdict.evidence import Absent, known
from pipeline.verdict.verdict import Missing

# glyph of a verdict, by the states that the pages know
GLYPHS = {HOLDS: "passed", SHAPE: "passed", FAILS: "failed", OPEN: "open"}
# what else the second pipeline makes for a paper's results; told if it is older than its method
PARTS = {"setpoint": ("search_agent", "train_agent", "camera")}


def render(sources: Sources, files: Mapping[str, tuple[str, str]], others: Mapping[str, str]) -> str:
    """The page of the papers in `files`, {key: (printed, results)}; `others` are the files of the stages
    reproduce_study and relearned."""
    course, classified = (known(sources.tables[name], None) for name in ("course", "classified"))
    tables = {"course": course if course and len(course["epoch"]) else None, "classified": classified}
    shown, gaps = [], []
    for key, (printed, results) in files.items():
        paper = read(printed, results, sources.metrics)
        if isinstance(paper, Missing):
            gaps.append((key, paper))
            continue
        shown.append(
            {
                "key": key,
                "paper": paper,
                "rows": paper.rows,
                "pictures": pictures(
                    key, paper.results, tables, [mark for row in paper.rows for mark in row.marks]
                ),
                "files": (printed, results),
                "made": " ".join(
                    made.sentence(one) for one in (key, *filter(made.changed, PARTS.get(key, ())))
                ),
            }
        )
    papers = [one["paper"] for one in shown]
    return page.render(
        "papers.html",
        here="papers",
        sources=sources,
        title="Three papers beside us",
        decision=decision(papers),
        verdicts=(HOLDS, SHAPE, "only with a change", FAILS, OPEN),
        counts=[
            {"key": paper.key, "title": paper.title, "rows": len(paper.rows), "counts": counts(paper)}
            for paper in papers
        ],
        papers=shown,
        gaps=gaps,
        state=GLYPHS,
        fails=FAILS,
        study=_results(others["reproduce_study"], "reproduce_study"),
        ranking=ranking,
        relearned=_by_length(others["relearned"]),
        made={name: made.sentence(name) for name in others},
    )


@as_table()
def _results(path: str, stage: str) -> dict[str, Any]:
    if not artifacts.exists(path):
        raise Absent(Missing("not measured", f"{path} is not there", f"Run {made.command(stage)}"))
    return artifacts.read_json(path)


def _by_length(path: str) -> dict[str, Any]:
    found = _results(path, "relearned")
    if found["missing"]:
        return found
    curve, step = found["curve"], found["sample_time_s"]
    finding = _pair_by_length(curve["answers"], step)
    found |= {"finding": finding, "picture": cost_curve(curve, step, finding), "key": cost_key(curve)}
    return found | {"apart": _apart(curve)}


def _pair_by_length(answers: Mapping[str, Any], step: float) -> str:
    """Says in a sentence which kind wins the pair at each length. Each kind answers by the controller that
    its own tuning found cheapest, so one kind may win by different controllers."""
    won: dict[str, list[str]] = {"model-based": [], "data-driven": []}
    for samples, answered in answers.items():
        wins = answered["pair_winner"].items()
        counts = {
            kind: sum(n for name, n in wins if name in BY_NAME and BY_NAME[name].kind == kind) for kind in won
        }
        first = max(counts, key=lambda kind: counts[kind])
        minutes = f"{number(int(samples) * step / 60, 0)} min ({counts[first]} of {answered['records']})"
        if 2 * counts[first] > answered["records"]:
            won[first].append(minutes)
    said = [f"The {kind} controller wins from records of {listed(at)}." for kind, at in won.items() if at]
    if len(said) == 1:
        undecided = len(answers) - sum(map(len, won.values()))
        said.append("The other lengths decide nothing." if undecided else "No length turns the answer round.")
    return " ".join(said) or "No length gives one kind most of the records."


def _apart(curve: Mapping[str, Any]) -> list[tuple[int, str, float, float]]:
    """Returns the records on which a controller costs more than ten times its median of that length: samples,
    controller, cost and median."""
    return [
        (int(samples), name, cost, median(costs))
        for samples, answered in curve["answers"].items()
        for name, costs in answered["costs"].items()
        if name in curve["controllers"]
        for cost in costs
        if cost > 10 * median(costs)
    ]


def decision(papers: Sequence[Paper]) -> str:
    """What all papers come to, in a sentence."""
    if not papers:
        return "No paper is set beside us: the results are not there."
    holds, shape, mended, fails, opened = (sum(column) for column in zip(*map(counts, papers), strict=True))
    return (
        f"Of {holds + shape + mended + fails + opened} tables, figures and numbers {holds} hold, {shape} in "
        f"shape, {mended} only with a named change, {fails} do not; {opened} cannot be judged."
    )


def counts(paper: Paper) -> list[int]:
    """How many rows hold, hold in shape, hold only with the change that they name, do not hold, and cannot be
    judged."""
    holds, shape, fails, opened = (paper.count(verdict) for verdict in VERDICTS)
    return [holds, shape, paper.mended(), fails - paper.mended(), opened]
