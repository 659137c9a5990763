"""Figures, a few tables, certificates and the rules -> datasets/verdict: temperature.json, deposition.json,
setpoint.json, and identification.json on the model of the temperature loop.

A verdict says who should run, the first rule that failed or is undecided, and what to do (pipeline/verdict,
rules.toml). Pages, export, README and the nightly job read it. A loop that is switched off has none.
"""

from typing import Any

import stages
from pipeline.store import artifacts

METRICS = ("*.state", "*.winner")
CERTIFIED = "datasets/certify/certified.json"


def main() -> None:
    from pipeline.verdict import loops
    from pipeline.verdict.files import read_evidence
    from pipeline.verdict.verdict import write

    with artifacts.stage("verdict") as out:
        evidence = read_evidence()
        evidence = evidence._replace(certified=certificates(evidence.rules))
        verdicts = loops.verdicts(evidence)
        write(loops.with_model(evidence, verdicts), out)
        figures = {loop: verdict.metrics() for loop, verdict in verdicts.items()}
        artifacts.write_metrics("verdict", figures, METRICS)


def certificates(rules: Any) -> dict[str, dict[str, dict[str, Any]]]:
    """{loop: {controller: {"passed", "why"}}} by the limits of `report`; {} if certify did not run."""
    from pipeline.runtime import certified

    if not artifacts.exists(CERTIFIED):
        return {}
    temperature = certified.results(
        "datasets/certify",
        settled_error_degC=rules.settled_error_degC,
        disk_margin=rules.disk_margin,
        delay_margin_s=rules.delay_margin_s,
    )
    setpoint = artifacts.read_json(CERTIFIED).get("setpoint", {})
    refused = (
        {setpoint["controller"]: {"passed": False, "why": setpoint["why"]}}
        if setpoint.get("controller") and not setpoint.get("measured", True)
        else {}
    )
    return {"temperature": temperature, "setpoint": refused}


if __name__ == "__main__":
    stages.run(main, "verdict")
