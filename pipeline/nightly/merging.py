"""Two branches whose nights went on apart become one: recordings of both, champions and locks of ours; the
night that follows judges what both together teach."""

from pipeline.nightly import champion, guarding
from pipeline.nightly.processes import dvc, git, identity
from pipeline.report.nightly.production import ChampionState, HistoryLine

# made by nights: of these, either side is right, and the next night makes them anew
OURS = ("dvc.lock", "reports/metrics", "champion.json", "champion")


def merge(branch: str) -> str:
    """Merges `branch`; where both sides' nights wrote, ours stays and the history of both is kept. Raises
    ValueError where people's own files conflict, and gives the merge up."""
    with guarding.alone():
        if git("status", "--porcelain", "--untracked-files=no"):
            raise ValueError(
                "expected everything committed before a merge, found changes; "
                "commit or stash them (git status), and run it again"
            )
        if not git("rev-parse", "--verify", "-q", branch, check=False):
            raise ValueError(f"{branch} is no branch of this repository; git branch -a lists them")
        mine, theirs = champion.read(), champion.of_branch(branch)
        git("merge", "--no-commit", "--no-ff", "--no-edit", branch, check=False, env=identity())
        if not git("rev-parse", "-q", "--verify", "MERGE_HEAD", check=False):
            return f"{branch} has nothing that is not here already"
        if tracked := git("ls-tree", "-r", "--name-only", "HEAD", "--", *OURS).splitlines():
            git("checkout", "-q", "HEAD", "--", *tracked)
        conflicts = git("diff", "--name-only", "--diff-filter=U").splitlines()
        if conflicts:
            git("merge", "--abort")
            raise ValueError(
                f"{branch} and this branch both changed {', '.join(conflicts)}; "
                f"merge them by hand (git merge {branch}), then run ./run beadline nightly"
            )
        champion.write(_joined(mine, theirs))
        git("add", "--", str(champion.FILE))
        git("commit", "-q", "--no-edit", env=identity())
        dvc("checkout", "--quiet", "--force", *(path for path in champion.paths() if path.endswith(".dvc")))
        return f"{branch} is merged: recordings of both, champions of this branch"


def _joined(mine: ChampionState, theirs: ChampionState) -> ChampionState:
    """The history of both by time; a loop that has no champion here keeps theirs."""
    ours = {_key(line) for line in mine.history}
    both = [*mine.history, *(line for line in theirs.history if _key(line) not in ours)]
    champions = {**theirs.champions, **mine.champions}
    return ChampionState(champions, tuple(sorted(both, key=lambda line: line.when)))


def _key(line: HistoryLine) -> tuple[str, str, str]:
    return line.loop, line.when, line.champion.md5
