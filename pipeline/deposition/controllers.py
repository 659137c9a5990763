"""The table of controllers of the deposition loop: laws that learn a command trial by trial, and composers
that make the command of a part. Each has one row with its name, its heading on pages and its kind.

A name is written to artifacts: column `law` of trials.parquet and lessons.parquet, column `composer` of
scores.parquet, and `<name>_mm3_per_s` of signals.parquet. It never changes. A kind is never guessed from a
name.

Kinds: a data-driven command was learned trial by trial, on training routines or as a library of their
signals. A model-based command inverts the identified chain of the extruder. On-off control and pressure
advance are the baselines. A command that was learned on the part itself is the reference, because no other
composer knows the part beforehand.
"""

from typing import Literal, NamedTuple


class DepositionController(NamedTuple):
    """One controller of this loop."""

    name: str
    heading: str
    kind: Literal["model-based", "data-driven", "baseline", "reference"]
    explanation: str
    flow: str = ""  # meaning of its column in signals.parquet; a law has none


# in the order of every page
LAWS = (
    DepositionController("hoelzle_2009", "The paper’s law", "data-driven", "nominal model, Q both ways"),
    DepositionController(
        "hoelzle_2009_nominal", "The paper’s law, nominal", "data-driven", "on its own nominal model"
    ),
    DepositionController("model_inverse", "Model inversion", "data-driven", "identified model, inverted"),
    DepositionController(
        "pixels", "Model inversion through pictures", "data-driven", "flow measured from camera frames"
    ),
)
# the simplest first
COMPOSERS = (
    DepositionController(
        "on_off", "On\u2011off", "baseline", "wanted flow over gain",
        "true flow of on-off control; predicted on a real machine",
    ),
    DepositionController(
        "pressure_advance", "Pressure advance", "baseline", "as in Klipper, tuned on the chain",
        "the same of pressure advance",
    ),
    DepositionController(
        "pressure_advance_lead", "Pressure advance, lead", "baseline", "the same, sent ahead",
        "the same of pressure advance sent ahead",
    ),
    DepositionController(
        "priority", "Library, priority", "data-driven", "the paper’s rule",
        "the same of the library by the priority rule",
    ),
    DepositionController(
        "superposition", "Library, superposition", "data-driven", "overlaps are added",
        "the same of the library by superposition",
    ),
    DepositionController(
        "basis", "Basis functions", "model-based", "identified chain, inverted",
        "the same of the basis functions",
    ),
    DepositionController(
        "ilc", "Learned whole", "reference", "trials of this very part",
        "the same after full-part ILC; missing on a real machine",
    ),
)  # fmt: skip
CONTROLLERS = {controller.name: controller for controller in (*LAWS, *COMPOSERS)}
