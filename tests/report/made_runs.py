"""A git of runs, made by one fast-import: revisions with any files, and DVC's experiments beside them."""

import json
import subprocess
from pathlib import Path
from typing import NamedTuple

import yaml


class Made(NamedTuple):
    """A revision, or the experiment `name` that began from revision number `base`."""

    subject: str
    files: dict
    name: str = ""
    base: int = 0


def make(runs):
    """A git of `runs` in the working directory, the hash of each. An experiment has its base's files too."""
    stream, before = [], None
    for k, run in enumerate(runs, 1):
        message = run.subject.encode()
        ref = f"refs/made/{k}" if run.name else "refs/heads/main"
        stream.append(
            b"commit %s\nmark :%d\ncommitter A <a@b> %d +0000\ndata %d\n%s\n"
            % (ref.encode(), k, 1_700_000_000 + 3600 * k, len(message), message)
        )
        base = run.base + 1 if run.name else before
        stream.append(b"from :%d\n" % base if base else b"")
        for name, data in run.files.items():
            text = data.encode() if isinstance(data, str) else json.dumps(data).encode()
            stream.append(b"M 100644 inline %s\ndata %d\n%s\n" % (name.encode(), len(text), text))
        before = before if run.name else k
    subprocess.run(["git", "init", "-q", "-b", "main"], check=True)
    marks = ["--export-marks=.git/marks"]
    subprocess.run(["git", "fast-import", "--quiet", *marks], input=b"".join(stream), check=True)
    hashes = dict(line.split() for line in Path(".git/marks").read_text().splitlines())
    found = [hashes[f":{k}"] for k in range(1, len(runs) + 1)]
    refs = [
        f"create refs/exps/{found[run.base][:2]}/{found[run.base][2:]}/{run.name} {own}"
        for run, own in zip(runs, found, strict=True)
        if run.name
    ]
    subprocess.run(["git", "update-ref", "--stdin"], input="\n".join([*refs, ""]), text=True, check=True)
    subprocess.run(["git", "checkout", "-q", "-f", "main"], check=True)
    return found


def ends(value, low=0.9, high=1.1):
    return {"median": value, "low": low * value, "high": high * value}


def metrics(settling=26.0, stay=71.0, flow=2.5, winner="pi_simc"):
    """Figures of the three loops in the files of reports/metrics."""
    figures = {"settling": ends(settling), "cost": ends(3.0), "disk": ends(0.5, 1, 1)}
    cases = {
        "accuracy 0.9": {"runs": 252, "settled": 99.0, "stay": 98.0, "low": 95.0, "high": 99.0},
        "recorded, sticky": {"runs": 252, "settled": 75.0, "stay": stay, "low": stay - 9, "high": stay + 9},
    }
    harm = {
        "perfect": {"beyond_25": 0.5, "beyond_25_low": 0.1, "beyond_25_high": 4.0},
        "perfect, another camera": {"beyond_25": 60.0, "beyond_25_low": 50.0, "beyond_25_high": 70.0},
    }
    verdicts = {"temperature": "passed", "deposition": "not measured", "setpoint": "failed"}
    report = {
        "verdict": {"state": "passed", "decision": "Pass (simulation).", "winner": winner},
        "verdicts": {loop: {"state": state} for loop, state in verdicts.items()},
        "figures": {winner: figures},
    }
    composer = {"rms_percent_of_on_off": flow, "worst_line_volume_percent": 2.0}
    return {
        "reports/metrics/report.json": report,
        "reports/metrics/compose_parts.json": {"square": {"A": {"basis": composer, "chosen": "basis"}}},
        "reports/metrics/train_ilc.json": {"A": {"model_inverse": {"last_ratio": 0.02}}},
        "reports/metrics/evaluate_setpoint.json": {"default": "Bayes filter", "cases": cases, "harm": harm},
        "reports/metrics/train_classifier.json": {
            "right_70_150": {"percent": 82.5, "low": 78.0, "high": 87.0}
        },
        "reports/metrics/evaluate_temperature.json": {"contestants": {winner: {}}, "best": winner},
    }


def parameters(**tune):
    """Both files of parameters, with these keys of tune_weights."""
    expert = {"tune_weights": {"seed": 1, "budget": 60} | tune, "evaluate_setpoint": {"seed": 3}}
    return {
        "params.yaml": "# what the owner sets\n" + yaml.safe_dump({"plant": {"sample_time_s": 1.0}}),
        "params.expert.yaml": yaml.safe_dump(expert),
    }
