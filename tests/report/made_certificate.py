"""What export_controllers leaves, made by hand: a certificate and the files of three loops."""

from typing import Any

from pipeline.store import artifacts

PATH = "datasets/export_controllers/temperature/certificate.json"
RULES = (
    ("signals", None, None, ""),
    ("samples", 20.5, 5.0, "for each unknown"),
    ("poles", 0.9975, 1.0, "1"),
    ("disk_margin", 0.85, 0.2, "1"),
    ("settled_error", 0.0, 5.0, "% of plants"),
)


def certificate(refused: str = "", *, evidence: str = "simulated", bands: bool = True) -> dict[str, Any]:
    """A certificate, refused by a rule where one is named; what comes after that rule was not asked."""
    names = [rule[0] for rule in RULES]
    at = names.index(refused) if refused else len(names)
    rules = [
        {
            "name": name,
            "passed": i < at,
            "found": found if i <= at else None,
            "limit": limit if i <= at else None,
            "unit": unit,
            "asked": i <= at,
            "sentence": f"{name} is <b>told</b>." if i <= at else f"Not asked, because {refused} failed.",
        }
        for i, (name, found, limit, unit) in enumerate(RULES)
    ]
    whole = not refused
    signals = [{"name": "heater_1", "unit": "percent", "low": 0.0, "high": 100.0}]
    loops = [{"of": "model", "radius": 0.99, "poles": [[0.99, 0.0]]}] + [
        {"of": "spread", "radius": 0.9975, "poles": [[0.9, 0.1], [0.9, -0.1]]}
    ]
    table = {
        "level": 0.9,
        "resamples": 200,
        "on": ["zone_1"],
        "gain": [[2.0]],
        "low": [[1.5]],
        "high": [[2.6]],
    }
    return {
        "version": 1, "loop": "temperature", "controller": "pi", "controller_sha256": "1" * 64,
        "plant_sha256": "2" * 64, "spread_sha256": "3" * 64, "evidence": evidence, "sample_time_s": 1.0,
        "inputs": signals, "outputs": [{"name": "zone_1", "unit": "degC", "low": None, "high": 250.0}],
        "samples": [4500, 1500], "poles": loops if whole else [],
        "margins": {"plants": 45, "disk": [0.86, 0.85, 0.84], "delay_s": [2.2, 2.1, None]} if whole else None,
        "worst": {"plants": 1000, "settled_error_degC": [0.02, 0.04, 0.2], "failing": 0, "diverged": 0}
        if whole else None,
        "violations": [], "bands": table if whole and bands else None, "rules": rules,
        "verdict": "passed" if whole else "refused", "first_failed": refused or None,
        "conditions": "No fan is declared.",
    }  # fmt: skip


def write(refused: str = "", *, evidence: str = "simulated", bands: bool = True) -> None:
    """The certificate and the metrics of export_controllers."""
    shown = certificate(refused, evidence=evidence, bands=bands)
    artifacts.write_json(PATH, shown)
    brief = {
        "sha256": artifacts.sha256(PATH),
        "rules": [
            {key: rule[key] for key in ("name", "passed", "found", "limit", "unit")}
            for rule in shown["rules"]
        ],
        **{
            key: shown[key]
            for key in ("verdict", "first_failed", "evidence", "controller_sha256", "sample_time_s")
        },
    }
    mine = {f"temperature/{name}": "4" * 64 for name in ("c/law.c", "controller.json")}
    loops = {
        "temperature": ("pi", brief, f"The certificate is refused by its rule {refused}." if refused else "",
                        {} if refused else mine, {"judged": 1.1e-13, "python": 4e-13}, "percent"),
        "setpoint": ("our agent", None, "No certificate is asked.", {"setpoint/flow_reader.py": "5" * 64},
                     {"log_flow": 6e-7}, "1"),
        "deposition": ("composed commands", None, "Commands, no law.",
                       {"datasets/compose_parts/signals.parquet": "6" * 64}, {}, "mm"),
    }  # fmt: skip
    names = ("contestant", "certificate", "why", "files", "largest_difference", "unit")
    artifacts.write_metrics(
        "export_controllers", {loop: dict(zip(names, fields, strict=True)) for loop, fields in loops.items()}
    )
