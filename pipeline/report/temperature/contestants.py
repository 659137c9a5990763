"""What the pages say of each contestant of the temperature loop: heading, kind, mark, explanation. In the
declared order of simplicity; the yardstick, which is told the true plant, stands last."""

from typing import Literal, NamedTuple


class Contestant(NamedTuple):
    """`name` is that of the artifacts. `heading` and `kind` stand above its column, `explanation` among the
    words of the page. `learned_from` says whose need of samples is its own. `mark` is the class of its mark;
    one without takes the next free shape."""

    name: str
    heading: str
    kind: str
    explanation: str
    learned_from: Literal["plant", "window", "kernel", ""] = "plant"
    mark: Literal["dd", "mb", "bl", ""] = ""
    hollow: bool = False


CONTESTANTS = (
    Contestant("hold", "Hold", "do nothing", "The inputs stay as they were when it took over.", ""),
    Contestant(
        "printer_pid",
        "The printer’s own PID",
        "as its log has it",
        "Klipper’s PID with the gains of the printer’s configuration, at our sample time. It is not tuned.",
        "",
    ),
    Contestant(
        "pi_simc",
        "PI, SIMC",
        "a rule of thumb",
        "One PI controller a zone, by SIMC from the identified model, with the sign of the identified gain.",
    ),
    Contestant(
        "pi",
        "PI, tuned",
        "tuned",
        "The same PI controllers, with gains that the optimiser found for the declared cost.",
        mark="bl",
    ),
    Contestant(
        "subspace_lqg",
        "subspace + LQG",
        "model-based",
        "A plant model is identified from the record by a subspace method; an observer estimates its state, "
        "and the Riccati equation gives the gains.",
        mark="mb",
    ),
    Contestant(
        "varx_riccati",
        "VARX + Riccati",
        "data-driven, indirect",
        "A long window of past inputs and outputs predicts the next output (VARX); the Riccati equation does "
        "the rest. No order and no state to choose.",
        "window",
        mark="dd",
        hollow=True,
    ),
    Contestant(
        "learned_kernel",
        "learned kernel",
        "data-driven, direct",
        "Algorithm 2 of the study on the predicted state: the value of state and action is fitted to the "
        "record directly, and the gain is read off it.",
        "kernel",
        mark="dd",
    ),
    Contestant(
        "exact_model",
        "Exact model",
        "yardstick",
        "The controller that is told the true plant: what a perfect identification would give. It is shown "
        "beside the others and is never the best of them.",
        "",
        mark="mb",
        hollow=True,
    ),
)
BY_NAME = {contestant.name: contestant for contestant in CONTESTANTS}
YARDSTICKS = ("exact_model",)
# the user asked to see model-based beside data-driven; the indirect one stands in where the kernel is refused
MODEL_BASED, DATA_DRIVEN, INDIRECT = "subspace_lqg", "learned_kernel", "varx_riccati"


def heading(name: str) -> str:
    """The heading of a contestant; of one that the pages do not know yet, its name."""
    return BY_NAME[name].heading if name in BY_NAME else name


def kind(name: str) -> str:
    return BY_NAME[name].kind if name in BY_NAME else ""


def in_a_sentence(name: str) -> str:
    """ "the learned kernel", "subspace + LQG", "hold"."""
    text = heading(name)
    if name in (DATA_DRIVEN, "exact_model"):
        return f"the {text[:1].lower()}{text[1:]}"
    return text if text.isupper() or text.startswith(("PI", "VARX")) else f"{text[:1].lower()}{text[1:]}"
