"""README's generated blocks: figures and verdicts of the accepted run, and counts of the papers -> Markdown.

`./run python -m tests.readme` writes them; tests/test_docs.py holds README against them. They are made from
reports/accepted.json and datasets/papers alone, so that an owner's own run changes no line.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.report.papers import page as papers_page
from pipeline.report.papers import rows
from pipeline.report.temperature.scorecard import setting
from pipeline.store import artifacts
from pipeline.verdict.controllers import heading, kind
from pipeline.verdict.decide import questions
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.temperature import comparison, names, of_controller
from pipeline.verdict.verdict import FAILED, UNDECIDED, Figure, Missing, Question, state
from pipeline.verdict.wording import places_of, worded

ACCEPTED, PAPERS = "reports/accepted.json", "datasets/papers"
KEYS = ("temperature", "setpoint", "deposition")
COMMAND = "./run python -m tests.readme"
SHOWN = ("settled_error", "settling", "overshoot")
STATES = {FAILED: ", fail", UNDECIDED: ", undecided"}
# sentences of the temperature verdict's reason that README repeats, by how they begin
MARGINS = ("Closest to its limit", "Below the limit on the worst plant")
LOOPS = {
    "temperature": (
        "**[Temperature](docs/explanation/temperature.md)**: one hot end, or the zones of a barrel",
        "heater power and temperatures",
        "a controller with a robustness certificate: C99, Python or Klipper module",
        "PI, LQG, VARX + Riccati, learned kernel, predictive control",
    ),
    "deposition": (
        "**[Deposition](docs/explanation/deposition.md)**: flow of a plunger extruder",
        "camera video, gantry and plunger position",
        "a plunger command for any G-code part, with a forecast",
        "on-off control, learned signal library, basis functions",
    ),
    "setpoint": (
        "**[Setpoint](docs/explanation/setpoint.md)**: flow and nozzle temperature",
        "images of a nozzle camera",
        "setpoint decisions, shown live and not sent",
        "sequential test, Bayes filter, DQN agent",
    ),
}


def blocks(accepted: Mapping[str, Any], papers: Path) -> dict[str, str]:
    """Each generated block, by its name."""
    return {
        "loops": _loops(accepted),
        "answers": _answers(accepted),
        "temperature": _temperature(accepted),
        "papers": _papers(accepted, papers),
    }


def rewritten(text: str, made: Mapping[str, str]) -> str:
    """README with these blocks in their places. Raises ValueError, naming the block that has no place."""
    for name, block in made.items():
        begin, end = f"<!-- {name}: written by {COMMAND} -->", f"<!-- /{name} -->"
        if begin not in text or end not in text:
            raise ValueError(f"README.md: expected the lines {begin} and {end}, found none; put them back")
        before, rest = text.split(begin, 1)
        text = f"{before}{begin}\n{block}\n{end}{rest.split(end, 1)[1]}"
    return text


def without_blocks(text: str) -> str:
    """README without what is generated."""
    return re.sub(r"<!-- (\w+): written by .*?<!-- /\1 -->", "", text, flags=re.DOTALL)


# ---- the three loops


def _loops(accepted: Mapping[str, Any]) -> str:
    """The table of the loops, with the verdict and the figure that decides."""
    results = {
        "temperature": _settling(accepted),
        "deposition": _flow_error(accepted),
        "setpoint": _reached(accepted),
    }
    lines = [
        "| Loop | You record | You get | Compared | Result (bundled simulations) |",
        "|---|---|---|---|---|",
    ]
    for loop, cells in LOOPS.items():
        decision = accepted["verdicts"][loop]["decision"]
        lines.append(f"| {' | '.join(cells)} | **{decision}** {results[loop]} |")
    return _plain("\n".join(lines))


def _answers(accepted: Mapping[str, Any]) -> str:
    """The question of the project, answered for each loop."""
    said = {loop: accepted["verdicts"][loop].get("short_answer", "") for loop in LOOPS}
    head = "Model-based against data-driven: "
    lines = [
        f"- **{loop.capitalize()}**: {answer.removeprefix(head)}" for loop, answer in said.items() if answer
    ]
    return _plain("\n".join(lines))


def _settling(accepted: Mapping[str, Any]) -> str:
    asked = {question.key: question for question in _questions(accepted)}["settling"]
    figure = of_controller(accepted["metrics"], accepted["verdicts"]["temperature"]["subject"])["settling"]
    return f"Settling time {_cell(asked, figure)} (at most {asked.limit:g} s)."


def _flow_error(accepted: Mapping[str, Any]) -> str:
    composer = accepted["verdicts"]["deposition"]["winner"]
    parts = [
        part
        for name, materials in accepted["metrics"]["compose_parts"].items()
        if name != "refused"
        for part in materials.values()
    ]
    error = max(part[composer]["rms_percent_of_on_off"] for part in parts)
    missing = sum(not part["judged"]["judged"] for part in parts)
    limit = accepted["params"]["report"]["flow_error_percent"]
    text = f"Largest flow error: {error:.1f} % of that of on-off control (at most {limit:g} %)."
    return f"{text} No valid forecast for {missing} of {len(parts)} parts." if missing else text


def _reached(accepted: Mapping[str, Any]) -> str:
    reached = min(case["settled"] for case in accepted["metrics"]["evaluate_setpoint"]["cases"].values())
    limit = accepted["params"]["report"]["settled_percent"]
    subject = accepted["verdicts"]["setpoint"]["subject"]
    return (
        f"In the worst test case {reached:.1f} % of runs reach the target (at least {limit:g} %). "
        f'Default controller: "{subject}".'
    )


# ---- the temperature loop


def _questions(accepted: Mapping[str, Any]) -> list[Question]:
    rules = ReportRules.model_validate(accepted["params"]["report"])
    return questions(rules, comparison(accepted["metrics"]))


def _temperature(accepted: Mapping[str, Any]) -> str:
    """The verdict's margins, the pair, and a row for each controller."""
    metrics = accepted["metrics"]
    asked = {question.key: question for question in _questions(accepted)}
    shown = [asked[key] for key in SHOWN]
    verdict = accepted["verdicts"]["temperature"]
    sentences = re.split(r"(?<=\.) (?=[A-Z])", verdict["reason"])
    lines = [
        " ".join([f"**{verdict['decision']}**", *(one for one in sentences if one.startswith(MARGINS))]),
        "",
        f"Test set: {setting(comparison(metrics))}. Nine in ten cases are better than the figure shown. "
        "Lower cost is better.",
        "",
        f"| Controller | {' | '.join(map(_head, shown))} | Cost, median case |",
        f"|---|{'---|' * (len(shown) + 1)}",
    ]
    for name in names(metrics):
        figures = of_controller(metrics, name)
        cells = " | ".join(_cell(question, figures[question.key]) for question in shown)
        cost = comparison(metrics)["contestants"][name]["cost"]["median"]
        lines.append(f"| {heading(name)} ({kind(name)}) | {cells} | {cost:.3g} |")
    return _plain("\n".join(lines))


def _head(question: Question) -> str:
    limit = f"{question.limit:g} {question.unit}".strip()
    return f"{question.title} (at {'least' if question.at_least else 'most'} {limit})"


def _cell(question: Question, figure: Figure | Missing) -> str:
    if isinstance(figure, Missing):
        return figure.state
    text = worded(question, figure.value, places_of(question, [figure]))
    return text + STATES.get(state(question, figure), "")


# ---- the papers


def _papers(accepted: Mapping[str, Any], folder: Path) -> str:
    """How many results of the papers are reproduced."""
    read = [
        rows.read(str(folder / f"{key}.toml"), str(folder / f"{key}.json"), accepted["metrics"])
        for key in KEYS
    ]
    return papers_page.decision([paper for paper in read if not isinstance(paper, Missing)])


def _plain(text: str) -> str:
    """Ordinary spaces and hyphens, so that the text can be searched."""
    return text.replace("\u202f", " ").replace("\u00a0", " ").replace("\u2011", "-")


def main(root: Path) -> None:
    path = root / "README.md"
    made = blocks(artifacts.read_json(root / ACCEPTED), root / PAPERS)
    path.write_text(rewritten(path.read_text(encoding="utf-8"), made), encoding="utf-8")


if __name__ == "__main__":
    main(Path(__file__).resolve().parents[1])
