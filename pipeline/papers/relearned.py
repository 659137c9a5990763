"""The temperature comparison by record length: what each controller costs that was learned and tuned from a
record of its own, and where the pair of a model-based and a data-driven one changes places.

`./run dvc repro datasets/papers/dvc.yaml:relearned` does everything anew for RECORDS fresh records of each
length (probing, identification, kernel, tuning of every controller, judging; each with seeds of its own, the
plants too), and removes and adds the prior of plant uncertainty for all controllers alike. It takes an hour
on two cores and writes datasets/papers/relearned.json, which papers.html shows. No verdict, choice or export
reads it.
"""

import argparse
import contextlib
import io
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from pipeline.papers import files
from pipeline.store import artifacts, params
from pipeline.temperature.controllers.table import CONTROLLERS
from pipeline.temperature.settings import TemperatureRules
from pipeline.temperature.tables import CASES
from pipeline.temperature.test_set.best import best_by_limits
from pipeline.temperature.test_set.record_length import curves
from stages import evaluate_temperature, identify_plant, ingest, learn_kernel, probe_machine, tune_weights
from stages.evaluate_temperature import EvaluateTemperature

COMMAND = "./run dvc repro datasets/papers/dvc.yaml:relearned"
STAGES = (probe_machine, ingest, identify_plant, learn_kernel, tune_weights, evaluate_temperature)
# samples of a record: a quarter of the default, the default, the study's own, and ten times the default
LENGTHS = (1500, 6000, 15000, 60000)
DEFAULT = 6000
RECORDS, PRIOR_RECORDS = 5, 3
# seeds that change from one relearning to the next: those of all random numbers
SEEDS = ("generate_probing.seed", "identify_plant.seed", "tune_weights.seed", "panel.training.seed",
         "panel.judging.seed")  # fmt: skip
PRIORS: dict[str, dict[str, Any]] = {
    # tuned on the identified plant alone, and windows learned for no other gain than the record's
    "removed": {"panel.training.spread": 0.0, "learn_kernel.gain_spread": 0.0},
    # half as much again as the test set, and windows learned for its whole range of gains
    "added": {"panel.training.spread": 1.5, "learn_kernel.gain_spread": 0.0866},
}


def relearn(drawn: Mapping[str, int], changes: Mapping[str, Any]) -> dict:
    """Runs the stages once in a folder of its own, with other seeds and other parameters, and returns its
    results. Raises ValueError if a stage fails."""
    root, began = Path.cwd(), time.process_time()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for path, values in params.files(root / params.FILE).items():
            file = Path(path).name
            for dotted, value in {**drawn, **changes, "execution.jobs": 1}.items():
                *parents, key = dotted.split(".")
                place = values
                for parent in parents:
                    place = place.get(parent, {}) if isinstance(place, dict) else {}
                new = dotted in changes and parents[0] in values and file == params.EXPERT
                if isinstance(place, dict) and (key in place or new):
                    place[key] = value
            artifacts.write_json(folder / file, values)  # JSON is YAML too
        (folder / "datasets" / "raw" / "temperature").mkdir(parents=True)
        with contextlib.chdir(folder):
            for stage in STAGES:
                said = io.StringIO()
                try:
                    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
                        stage.main()
                except SystemExit:
                    raise ValueError(f"a relearning failed: {said.getvalue().strip()}") from None
        compared = artifacts.read_json(folder / "datasets" / "evaluate_temperature" / "figures.json")
        cases = artifacts.read_table(folder / "datasets" / "evaluate_temperature" / "cases.parquet", CASES)
        rules = params.load(TemperatureRules, "report", folder / params.FILE)
        seed = params.load(EvaluateTemperature, "evaluate_temperature", folder / params.FILE).seed
        return {
            "cpu_s": time.process_time() - began,
            "costs": mean_log_costs(cases),
            "refused": compared["refused"],
            "pair": compared["pair"],
            "best": best_by_limits(compared, cases, rules.model_dump(), seed)["best"],
        }


def mean_log_costs(cases: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Returns for each controller the mean over plants of the logarithm of a plant's mean cost, as the
    comparison computes it. Controllers whose cost is missing in a case are left out."""
    result = {}
    for name in dict.fromkeys(cases["contestant"].tolist()):
        own = cases["contestant"] == name
        plant, cost = cases["plant"][own], cases["cost"][own]
        means = np.bincount(plant, weights=cost)[np.unique(plant)] / np.bincount(plant)[np.unique(plant)]
        if np.isfinite(means).all():
            result[str(name)] = float(np.log(np.maximum(means, 1e-9)).mean())
    return result


def answers(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns how often each controller was the best and won the pair, by how much, the cost of each on each
    record (none if it was refused), and the CPU time of all."""

    def counted(values: list) -> dict[str, int]:
        return {str(value): values.count(value) for value in dict.fromkeys(values)}

    return {
        "records": len(runs),
        "best": counted([run["best"] for run in runs]),
        "pair_winner": counted([run["pair"]["winner"] for run in runs]),
        "pair_difference_percent": [run["pair"]["difference"] for run in runs],
        "costs": {
            name: [round(float(np.exp(run["costs"][name])), 6) for run in runs if name in run["costs"]]
            for name in dict.fromkeys(name for run in runs for name in run["costs"])
        },
        "cpu_s": round(sum(run["cpu_s"] for run in runs)),
    }


def by_length(
    runs: Mapping[int, Sequence[Mapping[str, Any]]], names: Sequence[str], seed: int
) -> dict[str, Any]:
    """Returns the curve of cost against record length (`record_length.curves`, its bands over records) of the
    controllers `names`, and the answers by length. A controller that was refused on one of a length's records
    is missing at that length, with the reason."""
    costs, refused = [], {}
    for length, own in runs.items():
        known = [name for name in names if all(name in run["costs"] for run in own)]
        costs.append({name: np.array([run["costs"][name] for run in own]) for name in known})
        refused[str(length)] = {name: why for run in own for name, why in run["refused"].items()}
    pair = runs[list(runs)[-1]][0]["pair"]
    curve = curves(costs, list(runs), (pair["a"], pair["b"]), seed=seed)
    return curve | {
        "refused": {length: why for length, why in refused.items() if why},
        "answers": {str(length): answers(own) for length, own in runs.items()},
    }


def seeds(number: int) -> dict[str, int]:
    """Returns the seeds of one relearning. The plants for tuning differ from those for judging."""
    return dict.fromkeys(SEEDS, number) | {"panel.training.seed": 5000 + number}


def many(count: int, first: int, changes: Mapping[str, Any], jobs: int) -> list[dict]:
    """Runs `count` relearnings, each with new random numbers from seeds that begin with `first`."""
    changes = {"evaluate_temperature.cost_curve": False, **changes}
    work = [seeds(first + k) for k in range(count)]
    return joblib.Parallel(n_jobs=jobs)(joblib.delayed(relearn)(drawn, changes) for drawn in work)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=RECORDS, help="fresh records of each length")
    parser.add_argument("--jobs", type=int, default=2)
    chosen = parser.parse_args()
    machine = params.read()["plant"]
    runs = {
        length: many(chosen.records, 1000 * (k + 1), {"generate_probing.samples": length}, chosen.jobs)
        for k, length in enumerate(LENGTHS)
    }
    priors = {
        name: answers(many(PRIOR_RECORDS, 1000 * (LENGTHS.index(DEFAULT) + 1), changes, chosen.jobs))
        for name, changes in PRIORS.items()
    }
    compared = [one.name for one in CONTROLLERS if one.kind in ("model-based", "data-driven")]
    files.write(
        "relearned",
        {
            "command": COMMAND,
            "sample_time_s": machine["sample_time_s"],
            "default": DEFAULT,
            "records": chosen.records,
            "curve": by_length(runs, compared, seed=1),
            "prior": priors,
        },
    )


if __name__ == "__main__":
    main()
