"""How the settled runs of the setpoint loop's default moved since the accepted run."""

from pipeline.report.shared.difference import Change
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import MINUS, THIN, number
from pipeline.verdict.evidence import lookup
from pipeline.verdict.setpoint import Case, Cell, board, within
from pipeline.verdict.verdict import FAILED, Missing, Question, state

# points closer than this are one: the accepted figures are kept rounded
SAME = 0.05


def change(sources: Sources, case: Case, cell: Cell | None) -> Change:
    """How the settled runs of the default moved since the accepted run: beyond noise where the
    interval of the one and as wide a one about the other do not overlap."""
    if (
        sources.accepted is None
        or isinstance(sources.accepted, Missing)
        or cell is None
        or isinstance(cell.settled, Missing)
    ):
        return Change("first run")
    stage = lookup(sources.accepted, "metrics.evaluate_setpoint")
    name = None if isinstance(stage, Missing) else stage.get("default")
    cases = {} if not name or not isinstance(stage.get(name), dict) else stage[name]
    before = cases.get(case[0], {}).get(case[1], {}).get("settled")
    if before is None:
        return Change("new")
    now = cell.settled
    points = now.value - before
    if abs(points) < SAME:
        return Change("unchanged")
    # the accepted figure has the interval of today's: of as many runs, clustered as they are
    if now.low <= before + now.high - now.value and before - (now.value - now.low) <= now.high:
        return Change("within noise")
    question = Question(0, "", "Settled", "%", sources.declared.rules.settled_percent, True, "")
    text = (
        f"{'+' if points > 0 else MINUS}{number(abs(points), 1)}{THIN}points · "
        f"{'better' if points > 0 else 'worse'}"
    )
    return Change(text, moved=True, worse=points < 0 and state(question, now) == FAILED)


def changes(sources: Sources) -> list[tuple[str, Change]]:
    """Every case of the default that counts, with how its settled runs moved."""
    scores = board(sources.evidence, sources.subject("setpoint"))
    if isinstance(scores, Missing) or not scores.default:
        return []
    counting = scores.counting(scores.default)
    return [(within(case), change(sources, case, cell)) for case, cell in counting]
