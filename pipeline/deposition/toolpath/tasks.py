"""Moves and their motion -> the sequence of tasks, with look-ahead: runs, corners, gaps, changes of material.
Also checks which task may follow which (Hoelzle 2009, fig. 8)."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from pipeline.deposition.parts.library import CORNER, NO_FLOW, START, STEADY, STOP
from pipeline.deposition.toolpath.gcode import Kind, Moves
from pipeline.deposition.toolpath.motion import Motion

# between two materials the paper's Stop A, dwell, Start B: no task of either material
DWELL = "Dwell"
# words at which a machine waits for a person or ends: a run across one
# would stand still with the plunger pressing
HALTS = ("M0", "M1", "M2", "M25", "M30", "M112", "M226", "M600", "M601", "PAUSE", "CANCEL_PRINT")
TINY_S = 1e-6
# quicker than this, a change of speed is a step
STEP_S = 0.02


class PrintedLines(NamedTuple):
    """Every printed line (L,): its number in the program, its move, its tool, the run that it belongs to,
    begin and end in s, length in mm, cruising speed in mm/s. If the gantry takes STEP_S or longer from rest
    to that speed, the line begins in the middle of that ramp, early_s after the gantry starts, and ends
    late_s before it rests.

    first and last: whether it begins or ends its run; pause_s: the time lost at the junction after it (halts
    in place and slowing down); corner: whether that junction is a Corner.
    """

    line: np.ndarray
    move: np.ndarray
    tool: np.ndarray
    run: np.ndarray
    begin_s: np.ndarray
    end_s: np.ndarray
    length: np.ndarray
    speed: np.ndarray
    first: np.ndarray
    last: np.ndarray
    pause_s: np.ndarray
    corner: np.ndarray
    early_s: np.ndarray
    late_s: np.ndarray


class Tasks(NamedTuple):
    """The sequence (N,): name of the task, tool, number of the line that needs it, its event and its end in
    s, speed in mm/s, pause in s (of a Corner)."""

    task: np.ndarray
    tool: np.ndarray
    line: np.ndarray
    begin_s: np.ndarray
    end_s: np.ndarray
    speed: np.ndarray
    pause_s: np.ndarray


def printed_lines(moves: Moves, motion: Motion, *, corner_deg: float, longest_pause_s: float) -> PrintedLines:
    """Returns the printed lines. Two lines of one tool belong to one run if only a halt in place of at most
    `longest_pause_s` lies between them.

    A junction is a Corner if the path turns by `corner_deg` or more, or if the gantry halts there. Raises
    ValueError if nothing is printed.
    """
    at = np.flatnonzero((moves.kind == Kind.EXTRUDE) & (moves.length > 0))
    if not len(at):
        raise ValueError(
            f"tasks: expected lines that print but found none among {len(moves.line)} moves; "
            "is extrusion driven by another axis or a switch?"
        )
    begin, end = motion.begin_s[at], motion.begin_s[at] + motion.duration_s[at]
    way = np.concatenate([[0.0], np.cumsum(moves.length)])
    changes = np.cumsum((moves.kind == Kind.TOOL) | (moves.kind == Kind.HOME))
    between = way[at[1:]] - way[at[:-1] + 1]
    halt = np.maximum(begin[1:] - end[:-1], 0.0)
    joined = (
        (between < 1e-9)
        & (moves.tool[at[1:]] == moves.tool[at[:-1]])
        & (changes[at[1:]] == changes[at[:-1]])
        & (halt <= longest_pause_s)
    )
    joined = np.concatenate([[False], joined, [False]])
    speed = np.maximum(motion.cruise[at], 1e-9)
    slowing = motion.ramp_s[:, at] * (1 - (np.stack([motion.entry[at], motion.exit[at]]) / speed + 1) / 2)
    lost = np.append(halt + slowing[1][:-1] + slowing[0][1:], 0.0) * joined[1:]
    turned = np.append(np.nan_to_num(motion.turn[at[1:]]) >= np.radians(corner_deg) - 1e-9, False)
    corner = joined[1:] & (turned | (np.append(halt, 0.0) > TINY_S))
    first, last = ~joined[:-1], ~joined[1:]
    # the flow's step lies in the middle of its ramp, as the training routine has it
    rests = np.stack([first, last | corner])
    early, late = np.where(rests & (slowing >= STEP_S / 2), slowing, 0.0)
    return PrintedLines(
        moves.line[at],
        at,
        moves.tool[at],
        np.cumsum(first) - 1,
        begin + early,
        end - late,
        moves.length[at],
        speed,
        first,
        last,
        lost,
        corner,
        early,
        late,
    )


def sequence(lines: PrintedLines, *, end_s: float) -> Tasks:
    """Returns the tasks in their order: No-Flow, then for each run Start, Steady-State, (Corner,
    Steady-State)..., Stop, and No-Flow or, before another tool, Dwell.

    A task's event is when the gantry begins it, or is in the middle of its ramp. The signals are sent earlier
    by their leads, which needs looking ahead.
    """
    switched = np.append(lines.tool[1:] != lines.tool[:-1], False)
    flat = lines.first | np.concatenate([[False], lines.corner[:-1]])
    # by their rank on a line
    calls = (lines.first, flat, lines.corner, lines.last, lines.last)
    order = np.sort(np.concatenate([5 * np.flatnonzero(mask) + rank for rank, mask in enumerate(calls)]))
    which, rank = np.divmod(order, 5)
    del order
    # names once, not a copy a task
    task = np.array([START, STEADY, CORNER, STOP, NO_FLOW, DWELL], object)[
        rank + ((rank == 4) & switched[which])
    ]
    begin = np.where(rank < 2, lines.begin_s[which], lines.end_s[which])
    pause = np.where(rank == 2, lines.pause_s[which], 0.0)
    columns = [
        task,
        lines.tool[which],
        lines.line[which],
        begin,
        np.append(begin[1:], max(end_s, begin[-1])),
        lines.speed[which],
        pause,
    ]
    if lines.begin_s[0] > TINY_S:
        ahead = (NO_FLOW, lines.tool[0], lines.line[0], 0.0, lines.begin_s[0], lines.speed[0], 0.0)
        columns = [np.insert(column, 0, value) for value, column in zip(ahead, columns, strict=True)]
    return Tasks(*columns)


def refuse(lines: PrintedLines, moves: Moves, *, halts: Collection[int], switch_s: float) -> None:
    """Raises ValueError, with the line number, if a program would have to go from Steady-State to No-Flow
    without a Stop.

    There are two cases: a change of material with less than `switch_s` between the last line of the one and
    the first of the other (the rest of Stop A and the lead of Start B), and a halt (line numbers `halts`, see
    `halting`) in the middle of a run.
    """
    after = np.flatnonzero(
        (lines.tool[1:] != lines.tool[:-1]) & (lines.begin_s[1:] - lines.end_s[:-1] < switch_s - TINY_S)
    )
    if len(after):
        k = int(after[0])
        span = slice(lines.move[k] + 1, lines.move[k + 1] + 1)
        # the T word; if the tool changed without one, the line that prints with it
        change = np.append(moves.line[span][moves.kind[span] == Kind.TOOL], moves.line[span][-1])[0]
        raise ValueError(
            f"line {change}: T{lines.tool[k + 1]} comes {lines.begin_s[k + 1] - lines.end_s[k]:.2f} s after "
            f"line {lines.line[k]} still printed with T{lines.tool[k]}, so "
            f"Steady-State would go to No-Flow without a Stop; expected {switch_s:.2f} s between them: "
            f"write G4 P{1000 * switch_s:.0f} at the change"
        )
    halts = np.sort(np.asarray(list(halts), int))
    inside = np.searchsorted(lines.line, halts, side="right") - 1
    crossed = (inside >= 0) & (inside < len(lines.line) - 1)
    crossed[crossed] = ~lines.last[inside[crossed]]
    if crossed.any():
        raise ValueError(
            f"line {halts[crossed][0]}: the machine halts here while line {lines.line[inside[crossed][0]]} "
            "still prints, so Steady-State would go to No-Flow without a "
            "Stop; end the line with a travel before the halt"
        )


def halting(other_line: np.ndarray, other_word: np.ndarray) -> np.ndarray:
    """Returns the line numbers (H,) of words at which the machine waits for a person or ends."""
    return np.array(
        [
            line
            for line, word in zip(other_line, other_word, strict=True)
            if str(word).split(" ")[0].upper() in HALTS
        ],
        int,
    )
