"""The nightly job: new recordings in, `dvc repro`, challenger against champion, promote or keep, say so.

In git: `champion.json` (who is in production, loop by loop: hashes, figures, lineage, when, why; and the
history of it), `champion/<loop>.dvc`, dvc.lock, the stages' metrics, a tag for each promotion. In DVC's cache
and remote: the artifacts, for `champion/<loop>.dvc` is what `dvc add champion/<loop>` writes.

The night works in a throw-away copy (worktree.py) and lands by one commit (landing.py). **The commit is the
promotion**: references of git move whole or not at all, and the folders in champion/ follow what the last
commit says (champion.py). `datasets/` is the challenger, `champion/` is production.

In neither: `.beadline/` (ignored): the lock, the copy, a note of a landing under way, the nights so far, the
logs, what the last night saw. Losing it costs one repeated night.

The rule: a challenger is promoted if, on scenarios that no stage learns from, a paired test finds it better
beyond noise and by a margin that is worth a change, no guard figure is worse, and nothing has drifted;
otherwise the champion stays.
"""
