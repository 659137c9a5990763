"""The nightly job: new recordings in, `dvc repro`, challenger against champion, promote or keep, say so.

What is git's: `champion.json` (who is in production, loop by loop: hashes, figures, lineage, when, why; and
the history of it), `champion/<loop>.dvc`, dvc.lock, the stages' metrics. What is DVC's: the artifacts, in its
cache and remote, for `champion/<loop>.dvc` is what `dvc add champion/<loop>` writes. **The commit is the
promotion**: a reference of git moves whole or not at all, and whatever a killed night left in the working
tree is put back to what the last commit says. `datasets/` is the challenger, `champion/` is production.

What is neither's: `.beadline/` (ignored): the lock, the nights so far, the logs,
what the last night saw. Losing it costs one repeated night.

The rule: a challenger is promoted where, on scenarios that no stage learns from, a paired test
finds it better beyond noise and by a margin that is worth a change, no guard figure is worse, and
nothing has drifted; otherwise the champion stays.
"""
