"""Names the controllers of the temperature loop for verdicts and pages, from the table of controllers. A
controller that is not in the table keeps its own name."""

from pipeline.temperature.controllers.table import BY_NAME, CONTROLLERS

# shown with the others, but never named the best
YARDSTICKS = tuple(controller.name for controller in CONTROLLERS if controller.kind == "reference")


def heading(name: str) -> str:
    return BY_NAME[name].heading if name in BY_NAME else name


def kind(name: str) -> str:
    return BY_NAME[name].method if name in BY_NAME else ""


def in_a_sentence(name: str) -> str:
    """Returns "the learned kernel", "subspace + LQG", "hold"."""
    text = BY_NAME[name].word if name == "printer_pid" else heading(name)
    if text.startswith(("PI", "VARX")):
        return text
    article = "the " if name in ("learned_kernel", *YARDSTICKS) else ""
    return f"{article}{text[:1].lower()}{text[1:]}"
