"""How the pages of the deposition loop name and mark its composers, from the table of controllers."""

from pipeline.deposition.controllers import COMPOSERS
from pipeline.report.shared.sources import Sources

# what stands below a heading
PAPER = {row.name: row.explanation for row in COMPOSERS}
# marks of the other pages by kind, the second of a kind hollow: circle data-driven, square model-based and
# the reference, ring on-off control, a shape of its own every other baseline
_MARKS = {
    "model-based": ("model_based", "exact_model"),
    "data-driven": ("data_driven", "kernel"),
    "baseline": ("baseline", "triangle", "diamond"),
    "reference": ("exact_model",),
}
_OF_KIND = {kind: [row.name for row in COMPOSERS if row.kind == kind] for kind in _MARKS}
MARK = {row.name: _MARKS[row.kind][_OF_KIND[row.kind].index(row.name)] for row in COMPOSERS}
KIND = {row.name: row.kind for row in COMPOSERS}
# of composers that are drawn over one another; of the data-driven ones blue
LINE = {
    "basis": "line",
    "priority": "line dd",
    "superposition": "line dd dash",
    "pressure_advance": "line bl dash",
    "pressure_advance_lead": "line bl dash",
    "on_off": "line bl",
    "ilc": "line dash",
}
# what the two columns of its rules are, the mark of the second and that of the first
HEADS = ("Model\u2011based", "Data\u2011driven", "data_driven", "model_based")


def real(sources: Sources) -> bool:
    """Whether the trials are a machine's own, so that nobody knows its true flow."""
    return sources.evidence.recorded("train_ilc")
