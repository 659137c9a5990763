"""Figures, a few tables, certificates and the rules -> datasets/verdict: temperature.json, deposition.json,
setpoint.json, identification.json on the model of the temperature loop, certificates.json, which says which
certificates pass, and figures.json: the verdicts in short, and what the limits make of the temperature loop's
comparison.

A verdict says who should run, the first rule that failed or is undecided, and what to do (pipeline/verdict,
rules.toml). Pages, export, README and the nightly job read it. A loop that is switched off has none.
"""

from typing import TYPE_CHECKING, Any

import stages
from pipeline.store import artifacts

if TYPE_CHECKING:
    from pipeline.verdict.evidence import Evidence

METRICS = ("*.state", "*.winner")
CERTIFIED = "datasets/certify/certified.json"


def main() -> None:
    from pipeline.verdict import loops
    from pipeline.verdict.files import read_evidence
    from pipeline.verdict.verdict import CERTIFICATES, write

    with artifacts.stage("verdict") as out:
        evidence = read_evidence()
        judged, certified = {"comparison": judge_comparison(evidence)}, certificates(evidence.rules)
        evidence = evidence._replace(figures={**evidence.figures, "verdict": judged}, certified=certified)
        verdicts = loops.verdicts(evidence)
        write(loops.with_model(evidence, verdicts), out)
        artifacts.write_json(out / CERTIFICATES, evidence.certified)
        figures = {loop: verdict.metrics() for loop, verdict in verdicts.items()} | judged
        artifacts.write_metrics("verdict", figures, METRICS)


def judge_comparison(evidence: "Evidence") -> dict[str, Any]:
    """What the limits make of the temperature loop's comparison; {} if there is none."""
    from pipeline.temperature.tables import CASES
    from pipeline.temperature.test_set.best import best_by_limits, limits_of

    path, declared = "datasets/evaluate_temperature/cases.parquet", evidence.rules.model_dump()
    compared, seed = evidence.figures["evaluate_temperature"], evidence.params["evaluate_temperature"]["seed"]
    if "pace" not in compared:
        return {}
    if not artifacts.exists(path):  # figures of an accepted run without its tables: its comparison stands
        last = artifacts.DATASETS / "verdict" / "figures.json"
        kept = artifacts.read_json(last).get("comparison", {}) if artifacts.exists(last) else {}
        return {**kept, "limits": limits_of(compared["pace"], declared)}
    return best_by_limits(compared, artifacts.read_table(path, CASES), declared, seed)


def certificates(rules: Any) -> dict[str, dict[str, dict[str, Any]]]:
    """{loop: {controller: {"passed", "why"}}} by the limits of `report`; {} if certify did not run."""
    from pipeline.deploy import certificate

    if not artifacts.exists(CERTIFIED):
        return {}
    temperature = certificate.results(
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
