"""`./run beadline nightly | rollback`: exit status for a scheduler, one line for a person."""

import argparse
import functools
import sys
from typing import TYPE_CHECKING

from pipeline.store.printable import printable

if TYPE_CHECKING:
    from pipeline.nightly.reporting import Render


def nightly(arguments: argparse.Namespace, *, render: "Render") -> None:
    """The nightly job: new recordings, dvc repro, judge, promote or keep. Exit status 0: promoted, kept, or
    nothing new; 1: the night or one loop failed; a loop that failed keeps its controller, the others are
    judged; 3: drift alarm; 4: done, but recordings were set aside; 75: refused, another night is at work."""
    from pipeline.nightly import by_hand, night, reporting

    if arguments.accept_drift:
        print(printable(by_hand.accept(*arguments.accept_drift)))
        return
    status, summary = reporting.watchdog() if arguments.watch else night.nightly(render)
    print(printable(summary), file=sys.stderr if status else sys.stdout)
    sys.exit(status)


def rollback(arguments: argparse.Namespace) -> None:
    """Put an earlier champion back into production, bit by bit: that
    of RUN, or the one before the present one."""
    from pipeline.nightly import by_hand

    print(printable(by_hand.rollback(arguments.of, arguments.loop)))


def add(commands, render: "Render") -> None:
    """Adds the commands; `render` makes the page of a night."""
    command = commands.add_parser("nightly", help=nightly.__doc__, description=nightly.__doc__)
    command.add_argument(
        "--watch",
        action="store_true",
        help="only look whether the last success is older than nightly.watch_h",
    )
    command.add_argument(
        "--accept-drift",
        nargs=2,
        metavar=("LOOP", "WHY"),
        help="take what the alarm of LOOP saw for how things are from now on",
    )
    command.set_defaults(run=functools.partial(nightly, render=render))
    command = commands.add_parser("rollback", help=rollback.__doc__, description=rollback.__doc__)
    command.add_argument(
        "of",
        metavar="RUN",
        nargs="?",
        default="",
        help="such as night-0042; default: the champion before the present one",
    )
    command.add_argument("--loop", default="", help="only this loop")
    command.set_defaults(run=rollback)
