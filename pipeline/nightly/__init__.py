"""The nightly job: takes new recordings, runs `dvc repro`, compares the new controller (challenger) with the
one in production (champion), promotes or keeps, and reports.

In git: `champion.json` (what is in production, loop by loop: hashes, lineage, when, why; and its history),
`champion/<loop>.dvc`, dvc.lock, the stages' metrics, and a tag for each promotion. In DVC's cache and remote:
the artifacts, because `champion/<loop>.dvc` is what `dvc add champion/<loop>` writes.

A run works in a temporary copy (worktree.py) and ends with one commit (landing.py). **The commit is the
promotion**: git's references move all or none, and the folders in champion/ follow the last commit
(champion.py). `datasets/` is the challenger, `champion/` is production.

In neither: `.beadline/` (ignored), with the lock, the copy, a note of a landing in progress, the runs so far,
the logs, and what the last run saw. If it is lost, one run is repeated.

A challenger is promoted if a paired test, on scenarios that no stage learns from, finds it better beyond
noise and by a margin that is worth a change. Also, no guard figure may be worse, and nothing may have
drifted. Otherwise the champion is kept.
"""
