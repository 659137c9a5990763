"""Artifacts -> pages: reports/index.html, a page a loop (temperature.html, identification.html,
deposition.html, setpoint.html), certificate.html, papers.html, viewer.html with its columns in reports/data,
runs.html (this run beside the accepted one) and words.html.

It reads the figures and tables of every stage and reports/accepted.json. A missing file is shown as missing.
Every file read is hashed, and the pages carry the hashes. The drift on page one is that of the last night
(reports/metrics/nightly.json). The nightly job writes that file after the pages, so it is no dependency.
"""

import hashlib
from typing import TYPE_CHECKING

import stages
from pipeline.store import artifacts, params

if TYPE_CHECKING:
    from pipeline.report.shared.sources import Sources
    from pipeline.report.temperature.judgement import Judgement

# what the pages show of each stage: its figures, and its folder of tables
FIGURES = {
    "probe_machine": "datasets/probe_machine/figures.json",
    "generate_probing": "datasets/generate_probing/figures.json",
    "ingest": "datasets/ingest/figures.json",
    "identify_plant": "datasets/identify_plant/figures.json",
    "learn_kernel": "datasets/learn_kernel/figures.json",
    "tune_weights": "datasets/tune_weights/figures.json",
    "evaluate_temperature": "datasets/evaluate_temperature/figures.json",
    "train_ilc": "datasets/train_ilc/figures.json",
    "segment_library": "datasets/segment_library/figures.json",
    "compose_parts": "datasets/compose_parts/figures.json",
    "train_classifier": "datasets/train_classifier/figures.json",
    "train_agent": "datasets/papers/train_agent/figures.json",
    "evaluate_setpoint": "datasets/evaluate_setpoint/figures.json",
    "verdict": "datasets/verdict/figures.json",
    "export_controllers": "datasets/export_controllers/figures.json",
}
FOLDERS = {
    "ingest": "datasets/ingest",
    "identify_plant": "datasets/identify_plant",
    "tune_weights": "datasets/tune_weights",
    "evaluate_temperature": "datasets/evaluate_temperature",
    "train_ilc": "datasets/train_ilc",
    "segment_library": "datasets/segment_library",
    "compose_parts": "datasets/compose_parts",
    "train_classifier": "datasets/train_classifier",
    "train_agent": "datasets/papers/train_agent",
    "evaluate_setpoint": "datasets/evaluate_setpoint",
    "export_controllers": "datasets/export_controllers",
}
# the figures of control that DVC compares: each loop's verdict and the figures of its controller
METRICS = (
    "temperature",
    "settled_error_degC",
    "settling_s",
    "overshoot_degC",
    "disk_margin",
    "delay_margin_s",
    "cost",
    "deposition",
    "flow_error_percent",
    "line_volume_percent",
    "learned_percent",
    "setpoint",
    "settled_percent",
    "stay_percent",
    "disturbed_percent",
    "right_70_150_percent",
    "bands",
)
VERDICTS = "datasets/verdict"
# what the papers print, and ours beside it, which the second pipeline makes
PAPERS = {
    "temperature": ("datasets/papers/temperature.toml", "datasets/papers/temperature.json"),
    "setpoint": ("datasets/papers/setpoint.toml", "datasets/papers/setpoint.json"),
    "deposition": ("datasets/papers/deposition.toml", "datasets/papers/deposition.json"),
}
# and what else it makes of the papers' methods; the page says which of its files are older than their method
OTHERS = {
    "reproduce_study": "datasets/papers/reproduce_study.json",
    "relearned": "datasets/papers/relearned.json",
}
# what made.sentence holds against made.json, beside the code and the parameters
MADE = (
    "datasets/papers/made.json",
    "datasets/papers/params.yaml",
    "datasets/papers/search_agent.json",
    "datasets/papers/camera.json",
    "datasets/kept/train_classifier/figures.json",
    "datasets/papers/tic_tac_toe_five_tasks.gcode",
    "datasets/parts/fig9.gcode",
    "datasets/parts/tic_tac_toe.gcode",
    "datasets/published",
)


def of_loops(sources: "Sources", judged: "Judgement") -> dict[str, str]:
    """The pages of each loop; one sentence in their place if it is switched off."""
    from pipeline.report.about import page as about_page
    from pipeline.report.certificate import page as certificate_page
    from pipeline.report.deposition import page as deposition_page
    from pipeline.report.identification import page as identification_page
    from pipeline.report.setpoint import page as setpoint_page
    from pipeline.report.shared.page import LOOP_OF
    from pipeline.report.temperature import page as temperature_page

    pages = {
        "temperature": lambda: temperature_page.render(sources, judged),
        "identification": lambda: identification_page.render(sources),
        "deposition": lambda: deposition_page.render(sources),
        "setpoint": lambda: setpoint_page.render(sources),
        "certificate": lambda: certificate_page.render(sources, judged.verdict),
    }
    return {
        name: render() if LOOP_OF[name] in sources.verdicts else about_page.render_off(sources)
        for name, render in pages.items()
    }


def main() -> None:
    from pipeline.report.about import page as about_page
    from pipeline.report.index import page as index_page
    from pipeline.report.papers import page as papers_page
    from pipeline.report.runs import figures
    from pipeline.report.runs import page as runs_page
    from pipeline.report.shared.sources import Declared, collect, digest
    from pipeline.report.temperature.judgement import judgement, shown
    from pipeline.report.viewer import page as viewer_page
    from pipeline.temperature.settings import Plant, recorded
    from pipeline.verdict.settings import ReportRules

    with artifacts.stage("report"):
        declared = Declared(
            params.load(ReportRules, "report"),
            recorded(params.load(Plant, "plant"), "datasets/ingest/record.parquet"),
            params.read(),
        )
        sources = collect(
            declared, FIGURES, FOLDERS, "reports/accepted.json", ("pipeline", "stages"), VERDICTS
        )
        if not sources.verdicts:
            raise ValueError(f"{VERDICTS} holds no verdict of a loop; run ./run dvc repro verdict")
        if "temperature" in sources.stored and "identification" not in sources.stored:
            raise ValueError(f"{VERDICTS}/identification.json is missing; run ./run dvc repro verdict")
        judged = judgement(sources)
        told = {
            "verdict": judged.verdict.metrics(),
            "verdicts": {loop: verdict.metrics() for loop, verdict in sources.verdicts.items()},
            "figures": shown(judged),
        }
        viewer = viewer_page.render(sources, judged)
        pages = {
            "index": index_page.render(sources, judged),
            **of_loops(sources, judged),
            "papers": papers_page.render(sources, PAPERS, OTHERS),
            "viewer": viewer.text,
            "runs": runs_page.render(sources, judged, told),
            "words": about_page.render_words(sources),
        }
        artifacts.write_text("reports/index.html", pages["index"])
        artifacts.write_text("reports/temperature.html", pages["temperature"])
        artifacts.write_text("reports/identification.html", pages["identification"])
        artifacts.write_text("reports/deposition.html", pages["deposition"])
        artifacts.write_text("reports/setpoint.html", pages["setpoint"])
        artifacts.write_text("reports/certificate.html", pages["certificate"])
        artifacts.write_text("reports/papers.html", pages["papers"])
        artifacts.write_text("reports/viewer.html", pages["viewer"])
        artifacts.write_text("reports/runs.html", pages["runs"])
        artifacts.write_text("reports/words.html", pages["words"])
        # `accept` keeps these
        drawn = figures.as_json(figures.curves(sources.tables))
        artifacts.write_folder("reports/data", {**viewer.files, "curves.json": drawn})
        artifacts.write_metrics(
            "report",
            {
                **figures.headline({**sources.measured, "report": told}),
                **told,
                "bytes": {name: len(text.encode()) for name, text in pages.items()},
                "pictures": {name: text.count('role="img"') for name, text in pages.items()},
                "pages": {name: hashlib.sha256(text.encode()).hexdigest() for name, text in pages.items()},
                "read": {path: source.sha256 for path, source in sources.read.items()},
                "parameters": digest(declared.everything),
                "code": sources.code,
            },
            METRICS,
        )


if __name__ == "__main__":
    stages.run(main, "report")
