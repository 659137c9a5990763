"""What relearnings of the temperature loop from fresh records came to, in sentences."""

from collections.abc import Mapping
from typing import Any

from pipeline.verdict.controllers import in_a_sentence
from pipeline.verdict.digits import count, number
from pipeline.verdict.evidence import instead, need
from pipeline.verdict.verdict import Missing


@instead(lambda gap: [gap.sentence()])
def sentences(results: Mapping[str, Any] | Missing) -> list[str]:
    """How often each controller was the best and won the pair, and which pair a changed prior gives."""
    results = need(results)
    answers = results["answers"]
    told = [
        f"{count(results['relearnings'], 'fresh record')} of the bundled simulated machine, each learned and "
        f"judged from the beginning: the best was {_listed(answers['best'])}. The pair went to "
        f"{_listed(answers['pair_winner'])}."
    ]
    for change, runs in results.get("prior", {}).items():
        told.append(
            f"With the prior of plant uncertainty {change} the pair went to {_listed(runs['pair_winner'])}."
        )
    return [*told, "No verdict, choice or export reads these figures."]


def _listed(counts: Mapping[str, int]) -> str:
    names = {name: "nobody" if name == "None" else in_a_sentence(name) for name in counts}
    return ", ".join(f"{names[name]} in {number(times, 0)}" for name, times in counts.items())
