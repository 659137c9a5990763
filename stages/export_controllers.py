"""Export the controller that the verdict names: copies the files that the stage certify prepared, and writes
the certificate under the limits of section `report`. Reads datasets/verdict/temperature.json,
datasets/certify and, of the deposition loop, what compose_parts wrote.

Writes datasets/export_controllers: temperature/ (controller.json, arrays.safetensors, support.safetensors,
certificate.json, state_space/, c/, python/), setpoint/, and exported.json, which says what there is, and why
not."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import stages
from pipeline.store import artifacts, params
from pipeline.temperature.settings import TemperatureRules
from stages.certify import NOT_ASKED

if TYPE_CHECKING:
    from pipeline.deploy.certificate import Certificate

MARKED = ("c/machine.h", "c/README.txt", "python/controller.py")  # which hold the certificate's SHA-256
VERDICTS, CERTIFY = Path("datasets/verdict"), Path("datasets/certify")
NOT_CERTIFIED = {"measured": False, "why": "Not exported: the stage certify did not measure it."}
COMPOSED = ("datasets/compose_parts/signals.parquet", "datasets/compose_parts/lines.parquet")

# figures of control that git keeps and that runs are compared by
METRICS = ("*.contestant", "*.certificate.verdict", "*.largest_difference")


def main() -> None:
    with artifacts.stage("export_controllers") as out:
        found, loops = artifacts.read_json(CERTIFY / "certified.json"), params.load(params.Loops, "loops")
        exported = {
            "temperature": describe(why=NOT_ASKED.format("temperature"), unit="percent"),
            "setpoint": export_setpoint(out / "setpoint", found["setpoint"]),
            "deposition": describe(why=NOT_ASKED.format("deposition"), unit="mm"),
        }
        if loops.temperature:
            exported["temperature"] = export_temperature(out / "temperature", found["temperature"])
        if loops.deposition:
            exported["deposition"] = name_composed()
        artifacts.write_json(out / "exported.json", exported)
        artifacts.write_metrics("export_controllers", exported, METRICS)


def export_temperature(folder: Path, found: dict[str, Any]) -> dict[str, Any]:
    """Files of the controller that the verdict names. If the verdict names none because the certificate of
    its controller is refused, that certificate alone."""
    from pipeline.deploy import certificate, machine, state_space

    verdict = artifacts.read_json(VERDICTS / "temperature.json")
    name = verdict["winner"] or verdict.get("refused")
    if name is None or name == "hold":
        why = f"Not exported: {verdict['decision']} {verdict['lead']} {verdict['reason']}".strip()
        if name:
            why = "Doing nothing is recommended: there is no controller to export."
        return describe(why=why, unit="percent")
    source, one = CERTIFY / "temperature" / name, found.get(name, NOT_CERTIFIED)
    if not one["measured"]:
        return describe(name, why=one["why"], unit="percent")
    rules = params.load(TemperatureRules, "report")
    decided = certificate.decide(
        certificate.read(source),
        settled_error_degC=rules.settled_error_degC,
        disk_margin=rules.disk_margin,
        delay_margin_s=rules.delay_margin_s,
    )
    artifacts.write_text(folder / "certificate.json", certificate.to_json(decided))
    if decided.verdict == "passed":
        copy(source, folder, certificate.sha256(decided))
        made = machine.read(folder)[0]
        for file, content in state_space.files(made).items():
            artifacts.write_bytes(folder / "state_space" / file, content)
    return describe(
        name,
        certificate=summarise(decided),
        why=certificate.refusal(decided),
        files=hashes(folder) if decided.verdict == "passed" else {},
        largest_difference=one["largest_difference"],
        unit="percent",
    )


def export_setpoint(folder: Path, found: dict[str, Any]) -> dict[str, Any]:
    """Classifier, filter and agent with their readers, if the loop is asked for."""
    source = CERTIFY / "setpoint"
    if source.exists():
        copy(source, folder, "")
    return describe(
        found["controller"],
        why=found["why"],
        files=hashes(folder),
        largest_difference=found["largest_difference"],
    )


def name_composed() -> dict[str, Any]:
    """The commands that compose wrote; they are exported there."""
    files = {path: artifacts.sha256(path) for path in COMPOSED if artifacts.exists(path)}
    why = "Commands are played as compose wrote them: there is no law to certify."
    return describe("composed commands", why=why, files=files, unit="mm")


def describe(
    contestant: str = "",
    *,
    certificate: dict[str, Any] | None = None,
    why: str,
    files: dict[str, str] | None = None,
    largest_difference: dict[str, float] | None = None,
    unit: str = "1",
) -> dict[str, Any]:
    """One loop in exported.json: its controller, its certificate in short or why there is none, files with
    their SHA-256, and the largest differences in `unit` by what was compared."""
    return {
        "contestant": contestant,
        "certificate": certificate,
        "why": why,
        "files": files or {},
        "largest_difference": largest_difference or {},
        "unit": unit,
    }


def summarise(decided: "Certificate") -> dict[str, Any]:
    from pipeline.deploy import certificate

    return {
        "sha256": certificate.sha256(decided),
        "verdict": decided.verdict,
        "first_failed": decided.first_failed,
        "evidence": decided.evidence,
        "controller_sha256": decided.controller_sha256,
        "plant_sha256": decided.plant_sha256,
        "spread_sha256": decided.spread_sha256,
        "sample_time_s": decided.sample_time_s,
        "rules": [
            {key: getattr(one, key) for key in ("name", "passed", "found", "limit", "unit")}
            for one in decided.rules
        ],
    }


def copy(source: Path, folder: Path, certificate_sha256: str) -> None:
    """The prepared files, with the SHA-256 in its marked places."""
    from pipeline.deploy.certificate import fill

    for path in files_below(source):
        name = path.relative_to(source).as_posix()
        if name in MARKED:
            artifacts.write_text(folder / name, fill(path, certificate_sha256))
        elif name != "measured.json":
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, folder / name)


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of each file below a folder of the stage, by its path below that of the stage."""
    return {
        path.relative_to(folder.parent).as_posix(): artifacts.sha256(path) for path in files_below(folder)
    }


def files_below(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob("*")) if path.is_file())


if __name__ == "__main__":
    stages.run(main, "export_controllers")
