"""Which frames make a window: in order, without a gap, at one flow setpoint."""

import numpy as np

from pipeline.recordings.watch_sources import CameraFrame
from pipeline.store.printable import counted

# frames further apart than this are of no one window
GAP_S = 2.0
# so many frames in a row that are older than one before: the clock was set back
SET_BACK = 5
# notes that one decision carries
NOTED = 20


class FrameWindows:
    """Frames as they come -> windows of frames that are in order, without a gap, and at one flow setpoint.
    `notes` says what was left out since they were last taken."""

    def __init__(self, length: int, settle_s: float) -> None:
        self.length, self.settle_s = length, settle_s
        self.frames: list[CameraFrame] = []
        self.notes: list[str] = []
        self.first_s, self.last_s, self.late = np.nan, -np.inf, 0
        self.flow, self.waits_until, self.waited = np.nan, -np.inf, 0

    def add(self, shown: CameraFrame) -> list[CameraFrame] | None:
        """The window that this frame fills, None if it fills none."""
        if not np.isfinite(shown.time_s):
            self.notes.append(f"{shown.name}: its time is no number")
            return None
        if not self._in_order(shown):
            return None
        moved = np.isfinite(shown.flow) and np.isfinite(self.flow) and shown.flow != self.flow
        if moved:
            self._drop(f"the flow setpoint moved from {self.flow:g} to {shown.flow:g} %")
            self.waits_until = shown.time_s + self.settle_s
        self.flow = shown.flow if np.isfinite(shown.flow) else self.flow
        if shown.time_s < self.waits_until:
            self.waited += 1
            return None
        if self.waited:
            self.notes.append(f"{counted(self.waited, 'frame')} passed while the melt followed the setpoint")
            self.waited = 0
        self.frames.append(shown)
        if len(self.frames) < self.length:
            return None
        full, self.frames = self.frames, []
        return full

    def _in_order(self, shown: CameraFrame) -> bool:
        since = shown.time_s - self.last_s
        if since < 0:
            self.late += 1
            if self.late < SET_BACK:
                self.notes.append(f"{shown.name} is {-since:.3g} s older than the frame before")
                return False
            self._drop(f"time went back by {-since:.3g} s")
            self.waits_until, self.first_s = -np.inf, shown.time_s
        elif since > GAP_S and np.isfinite(since):
            self._drop(f"no frame came for {since:.3g} s")
        self.late, self.last_s = 0, shown.time_s
        self.first_s = shown.time_s if np.isnan(self.first_s) else self.first_s
        return True

    def _drop(self, why: str) -> None:
        count = len(self.frames)
        begun = f"; {counted(count, 'frame')} {'fills' if count == 1 else 'fill'} no window" if count else ""
        self.notes.append(f"{why}{begun}")
        self.frames = []

    def taken_notes(self) -> list[str]:
        """The notes since the last call, of many the last ones."""
        notes, self.notes = self.notes, []
        return (
            [f"{counted(len(notes) - NOTED, 'note')} before these", *notes[-NOTED:]]
            if len(notes) > NOTED
            else notes
        )
