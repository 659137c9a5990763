"""How the settled runs of the setpoint loop's default moved since the accepted run."""

from pipeline.report.shared.difference import Change
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import MINUS, THIN, number
from pipeline.verdict.evidence import entry, gap_of, known, lookup
from pipeline.verdict.setpoint import Case, Cell, board, within
from pipeline.verdict.verdict import FAILED, Figure, Question, state

# points closer than this are one: the accepted figures are kept rounded
SAME = 0.05


def change(sources: Sources, case: Case, cell: Cell | None) -> Change:
    """How the settled runs of the default moved since the accepted run: beyond noise where the
    interval of the one and as wide a one about the other do not overlap."""
    if not known(sources.accepted, None) or cell is None or not isinstance(cell.settled, Figure):
        return Change("first run")
    stage = lookup(sources.accepted, "metrics.evaluate_setpoint")
    before = entry(stage, str(entry(stage, "default")), *case, "settled")
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
    if gap_of(scores) or not scores.default:
        return []
    counting = scores.counting(scores.default)
    return [(within(case), change(sources, case, cell)) for case, cell in counting]
