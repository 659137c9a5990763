"""The temperature comparison done again: would its sentences stay true on another record, with other tuning
seeds, on other plants, and with less or more prior knowledge of how far plants differ?

`./run dvc repro datasets/papers/dvc.yaml:relearned` relearns everything from fresh records (probing,
identification, kernel, tuning of every controller, judging; each with seeds of its own, the plants too),
tunes five times on one record, and removes and adds the prior for all controllers alike. It takes hours and
writes datasets/papers/relearned.json, which papers.html shows: the interval of the relearnings, smallest to
largest, into which a further one falls with probability (n - 1) / (n + 1). No verdict, choice or export reads
it. `./run python -m pipeline.papers.relearned --fresh 8` only counts how many figures of 8 further
relearnings lie in the intervals on file.
"""

import argparse
import contextlib
import io
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from pipeline.papers import files
from pipeline.store import artifacts, params
from pipeline.temperature.settings import TemperatureRules
from pipeline.temperature.tables import CASES
from pipeline.temperature.test_set.best import best_by_limits
from stages import evaluate_temperature, identify_plant, ingest, learn_kernel, probe_machine, tune_weights
from stages.evaluate_temperature import EvaluateTemperature

COMMAND = "./run dvc repro datasets/papers/dvc.yaml:relearned"
STAGES = (probe_machine, ingest, identify_plant, learn_kernel, tune_weights, evaluate_temperature)
FIGURES = ("settled_error", "settling", "overshoot", "at_limits", "energy", "cost", "rms")
ENDS = ("median", "q90")
# what a relearning changes: everything that is drawn
SEEDS = ("generate_probing.seed", "identify_plant.seed", "tune_weights.seed", "panel.training.seed",
         "panel.judging.seed")  # fmt: skip
PRIORS: dict[str, dict[str, Any]] = {
    # tuned on the identified plant alone, and windows learned for no other gain than the record's
    "removed": {"panel.training.spread": 0.0, "learn_kernel.gain_spread": 0.0},
    # half as much again as the panel, and windows learned for its whole spread of gains
    "added": {"panel.training.spread": 1.5, "learn_kernel.gain_spread": 0.0866},
}


def relearn(drawn: Mapping[str, int], changes: Mapping[str, Any]) -> dict:
    """The metrics of evaluate_temperature, and the cost of each tuned controller, of one run of the stages in
    a folder of its own, with other seeds and other parameters."""
    root = Path.cwd()
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
        compared, tuned = (
            artifacts.read_json(folder / "datasets" / name / "figures.json")
            for name in ("evaluate_temperature", "tune_weights")
        )
        cases = artifacts.read_table(folder / "datasets" / "evaluate_temperature" / "cases.parquet", CASES)
        rules = params.load(TemperatureRules, "report", folder / params.FILE)
        seed = params.load(EvaluateTemperature, "evaluate_temperature", folder / params.FILE).seed
        judged = best_by_limits(compared, cases, rules.model_dump(), seed)
        return (
            compared
            | judged
            | {"tuned_cost": {key: one["cost"] for key, one in tuned["contestants"].items()}}
        )


def figures(runs: list[dict]) -> dict[str, Any]:
    """By contestant and figure the smallest, middle and largest median and 90 % quantile of the runs; None
    where a run has none (never settles)."""
    names = [name for name in runs[0]["contestants"] if all(name in run["contestants"] for run in runs)]
    result: dict[str, Any] = {}
    for name in names:
        for figure in FIGURES:
            for end in ENDS:
                values = [run["contestants"][name][figure][end] for run in runs]
                finite = np.array([np.inf if value is None else value for value in values])
                low, middle, high = finite.min(), np.median(finite), finite.max()
                result.setdefault(name, {}).setdefault(figure, {})[end] = {
                    key: float(value) if np.isfinite(value) else None
                    for key, value in (("low", low), ("median", middle), ("high", high))
                }
    return result


def answers(runs: list[dict]) -> dict[str, Any]:
    """How often each contestant was the best, and won the pair; and the largest differences of the runs."""

    def counted(values: list) -> dict[str, int]:
        return {str(value): values.count(value) for value in dict.fromkeys(values)}

    return {
        "runs": len(runs),
        "best": counted([run["best"] for run in runs]),
        "leading": counted([run["best_reason"]["leading"] for run in runs]),
        "pair_winner": counted([run["pair"]["winner"] for run in runs]),
        "pair_difference_percent": [run["pair"]["difference"] for run in runs],
    }


def spread_percent(runs: list[dict]) -> dict[str, Any]:
    """Of runs on one record: by contestant the largest difference of the tuned cost, and of each 90 %
    quantile, in percent of the smallest."""
    result: dict[str, Any] = {}
    for name in runs[0]["tuned_cost"]:
        costs = np.array([run["tuned_cost"].get(name, np.nan) for run in runs])
        mine = {"cost": float(100 * (costs.max() / costs.min() - 1))}
        for figure in ("settled_error", "settling", "overshoot", "cost"):
            values = np.array(
                [
                    run["contestants"][name][figure]["q90"] or np.inf
                    for run in runs
                    if name in run["contestants"]
                ]
            )
            change = 100 * (values.max() / values.min() - 1) if np.isfinite(values).all() else np.inf
            mine[f"q90_{figure}"] = float(change) if np.isfinite(change) else None
        result[name] = mine
    return result


def cover(bands: Mapping[str, Any], runs: list[dict]) -> dict[str, Any]:
    """The share of fresh runs inside each band, in percent: the mean over all bands and the smallest."""
    shares = {}
    for name, by_figure in bands.items():
        for figure, by_end in by_figure.items():
            band = by_end["q90"]
            values = [run["contestants"].get(name, {}).get(figure, {}).get("q90") for run in runs]
            low, high = (np.inf if band[key] is None else band[key] for key in ("low", "high"))
            inside = [low <= (np.inf if value is None else value) <= high for value in values]
            shares[f"{name}.{figure}"] = 100 * float(np.mean(inside))
    return {
        "fresh": len(runs),
        "bands": len(shares),
        "mean_percent": float(np.mean(list(shares.values()))),
        "least_percent": float(min(shares.values())),
        "least": min(shares, key=lambda key: shares[key]),
    }


def seeds(number: int) -> dict[str, int]:
    """The seeds of one relearning; the plants to tune on are other plants than those to judge on."""
    return dict.fromkeys(SEEDS, number) | {"panel.training.seed": 5000 + number}


def many(count: int, first: int, changes: Mapping[str, Any], jobs: int) -> list[dict]:
    """`count` relearnings, everything drawn anew from seeds that begin with `first`."""
    work = [seeds(first + k) for k in range(count)]
    return list(
        joblib.Parallel(n_jobs=jobs, return_as="generator")(
            joblib.delayed(relearn)(drawn, changes) for drawn in work
        )
    )


def tune_again(jobs: int) -> list[dict]:
    """Five tuning seeds on the record that the parameters draw."""
    return joblib.Parallel(n_jobs=jobs)(
        joblib.delayed(relearn)({"tune_weights.seed": seed}, {}) for seed in range(1, 6)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--relearnings", type=int, default=16)
    parser.add_argument("--priors", type=int, default=4, help="relearnings without, and with more, prior")
    parser.add_argument(
        "--fresh", type=int, default=0, help="only: further relearnings against the file's bands"
    )
    parser.add_argument("--jobs", type=int, default=2)
    chosen = parser.parse_args()
    if chosen.fresh:
        on_file = artifacts.read_json("datasets/papers/relearned.json")
        runs = many(chosen.fresh, 9000, {}, chosen.jobs)
        print(json.dumps(cover(on_file["contestants"], runs) | {"answers": answers(runs)}, indent=1))
        return
    runs = many(chosen.relearnings, 1000, {}, chosen.jobs)
    machine = params.read()["plant"]
    result: dict[str, Any] = {
        "command": COMMAND,
        "machine": {
            "outputs": [o["name"] for o in machine["outputs"]],
            "sample_time_s": machine["sample_time_s"],
        },
        "relearnings": len(runs),
        "holds_percent": 100 * (len(runs) - 1) / (len(runs) + 1),
        "contestants": figures(runs),
        "answers": answers(runs),
    }
    again = tune_again(chosen.jobs)
    result["five_tuning_seeds"] = answers(again) | {"spread_percent": spread_percent(again)}
    if chosen.priors:
        result["prior"] = {
            name: answers(many(chosen.priors, 1000, changes, chosen.jobs)) for name, changes in PRIORS.items()
        }
    files.write("relearned", result)
    print(json.dumps({key: result.get(key) for key in ("answers", "five_tuning_seeds", "prior")}, indent=1))


if __name__ == "__main__":
    main()
