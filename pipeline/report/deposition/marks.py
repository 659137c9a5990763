"""How the pages of the deposition loop name and mark its composers, from the table of controllers."""

from pipeline.deposition.controllers import COMPOSERS
from pipeline.report.shared.sources import Sources

# what stands below a heading
PAPER = {row.name: row.explanation for row in COMPOSERS}
# marks of the other pages: circle data-driven, square model-based,
# ring baseline; hollow: a second of its kind
MARK = {
    "basis": "data_driven",
    "priority": "model_based",
    "superposition": "exact_model",
    "on_off": "baseline",
    "ilc": "kernel",
}
# what the two columns of its rules are, and the mark of the second
HEADS = ("Data\u2011driven", "The paper", "model_based")


def real(sources: Sources) -> bool:
    """Whether the trials are a machine's own, so that nobody knows its true flow."""
    return sources.evidence.recorded("train_ilc")
