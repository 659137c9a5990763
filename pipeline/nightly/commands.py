"""`./run beadline nightly`: a run, its watch, and manual changes of production."""

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.nightly.reporting import Render


def run(arguments: argparse.Namespace, render: "Render") -> tuple[int, str]:
    """Returns the exit status for a scheduler, and one line for a person; `render` makes the page of a
    run."""
    from pipeline.nightly import by_hand, night, reporting

    if arguments.accept_drift:
        return 0, by_hand.accept(*arguments.accept_drift)
    if arguments.rollback is not None:
        return 0, by_hand.rollback(*by_hand.named(arguments.rollback), dry_run=arguments.dry_run)
    if arguments.dry_run:
        return 0, night.preview()
    return reporting.watchdog() if arguments.watch else night.nightly(render)
