"""The study's figures as published, beside ours in its own way of counting."""

from typing import NamedTuple

from pipeline.report.shared.digits import number, percent
from pipeline.report.shared.sources import Sources, lookup
from pipeline.report.shared.verdict import Missing

# ---- as published

CONVENTIONS = {
    "model_based": (
        "Model-based, Q = R = I",
        (
            "J counts the observer’s temperatures, not the barrel’s, its first stage twice; the observer "
            "starts at 50 °C; “100” is the 100th sample."
        ),
    ),
    "model_based_tuned": (
        "Model-based, tuned",
        "The same, and J weighs with the tuned Q and R: another currency. The fifth q is 0.0514, "
        "not the printed 0.514.",
    ),
    "data_driven": (
        "Data-driven, Q = R = I",
        "Seven start-up steps first drive the barrel to 0 °C, and make 80 % of J; u′Ru is not discounted; "
        "all data are divided by 1000.",
    ),
    "data_driven_tuned": (
        "Data-driven, tuned",
        "The same; J weighs u with R = I although the controller was tuned for another R.",
    ),
}


class Reproduced(NamedTuple):
    """A printed figure, ours, and how far apart they lie where that is more than a thousandth."""

    printed: str
    ours: str
    off: str


class Convention(NamedTuple):
    """A column of the study and the way of counting that it takes."""

    title: str
    convention: str
    cells: list[Reproduced]


class Published(NamedTuple):
    missing: Missing | None
    rows: list[Convention]


def published(sources: Sources) -> Published:
    """The study's four columns, printed and reproduced, with the convention that it takes."""
    printed, reproduced = (
        lookup(sources.metrics["evaluate_temperature"], key) for key in ("printed", "as_published")
    )
    gap = next((part for part in (printed, reproduced) if isinstance(part, Missing)), None)
    if gap:
        return Published(gap, [])
    rows = []
    for key, (title, convention) in CONVENTIONS.items():
        if key in printed and key in reproduced:
            cells = [
                _reproduced(printed[key][name], reproduced[key][name], places)
                for name, places in (("J100", 1), ("J1000", 1), ("error", 4))
            ]
            rows.append(Convention(title, convention, cells))
    return Published(None, rows)


def _reproduced(theirs: float, ours: float, places: int) -> Reproduced:
    off = abs(ours / theirs - 1)
    return Reproduced(
        number(theirs, places), number(ours, places), percent(100 * off, 2) if off > 1e-3 else ""
    )


def honest(sources: Sources) -> list[tuple[str, str]]:
    """The same machine, counted once: true outputs, Q = R = I, from 20 °C."""
    evaluated = sources.metrics["evaluate_temperature"]
    items = (
        ("optimal.J1000", "Exact optimum, J over 1,000 steps", 1),
        ("observer.J1000", "Observer started from the first measurement", 1),
        ("observer.J1000_from_50_degC", "Observer started at 50 °C, as published", 1),
    )
    rows = [
        (
            title,
            value.state if isinstance(value := lookup(evaluated, key), Missing) else number(value, places),
        )
        for key, title, places in items
    ]
    gaps = (
        ("kernel.gap", "Kernel, noise-free, 500 samples: gap"),
        ("kernel.gap_window_6", "Kernel, window of 6, 1,610 samples: gap"),
        ("kernel.any_reference_gap", "Kernel, 20 random references from 540 samples: worst gap"),
        ("takeover.zero_history_gap", "Taking over with an empty history: gap"),
    )
    return rows + [
        (
            title,
            value.state if isinstance(value := lookup(evaluated, key), Missing) else percent(100 * value, 2),
        )
        for key, title in gaps
    ]
