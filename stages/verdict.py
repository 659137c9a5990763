"""Figures, a few tables, certificates and the rules -> datasets/verdict: temperature.json, deposition.json,
setpoint.json, and identification.json on the model of the temperature loop.

A verdict says who should run, the first rule that failed or is undecided, and what to do (pipeline/verdict,
rules.toml). Pages, export, README and the nightly job read it. A loop that is switched off has none.
"""

import stages
from pipeline.store import artifacts

METRICS = ("*.state", "*.winner")


def main() -> None:
    from pipeline.verdict import loops
    from pipeline.verdict.files import read_evidence
    from pipeline.verdict.verdict import write

    with artifacts.stage("verdict") as out:
        certified = {}
        if artifacts.exists("datasets/certify/certified.json"):
            certified = artifacts.read_json("datasets/certify/certified.json")
        evidence = read_evidence(certified)
        verdicts = loops.verdicts(evidence)
        write(loops.with_model(evidence, verdicts), out)
        artifacts.write_metrics(
            "verdict", {loop: verdict.metrics() for loop, verdict in verdicts.items()}, METRICS
        )


if __name__ == "__main__":
    stages.run(main, "verdict")
