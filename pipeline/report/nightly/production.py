"""What is in production, and what was: the records of champion.json, which the nightly job writes and its
page reads."""

from collections.abc import Mapping
from typing import Any, NamedTuple

ROLLED_BACK, DRIFT_ACCEPTED = "rolled back", "drift accepted"  # events of the history, beside promotions


def candidate_of(loop: str) -> str:
    """The folder below champion/ that a loop's candidate lies in."""
    return f"{loop}.candidate"


class Lineage(NamedTuple):
    """What a champion was made from: the commit, and what lay uncommitted on it. Then SHA-256 of dvc.lock, of
    the files of parameters, and of each loop's recordings by path."""

    commit: str = ""
    uncommitted: tuple[str, ...] = ()
    dvc_lock: str = ""
    params: Mapping[str, str] = {}
    recordings: Mapping[str, Mapping[str, str]] = {}

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "Lineage":
        lineage = cls(**{name: fields[name] for name in cls._fields if name in fields})
        return lineage._replace(uncommitted=tuple(lineage.uncommitted))

    def written(self) -> dict[str, Any]:
        return self._asdict() | {"uncommitted": list(self.uncommitted)}


class Installed(NamedTuple):
    """The files of champion/<loop>: what DVC's pointer says of the folder, MD5 by path, and of the outs of
    dvc.lock that they were copied from."""

    folder: Mapping[str, Any]
    files: Mapping[str, str] = {}
    outs: Mapping[str, str] = {}


class ChampionMetrics(NamedTuple):
    """What the judge measured of a champion when it was promoted: the panel's name, mean cost of its cases
    (None where one of them fails), and {guard: figure}."""

    panel: str
    mean_cost: float | None
    guards: Mapping[str, float]


class Champion(NamedTuple):
    """One loop's champion: the night that promoted it, when and why, its files, figures and lineage. `since`
    is the time of a rollback to it, empty where there was none.

    `contestant` is the controller that runs, by its name on the pages; of earlier versions it is empty.
    `rehearsal`: it was judged on simulated data alone. `verdict` is what the page said of it then. A
    candidate is written alike: a challenger that the page's rules kept out of production.
    """

    run: str
    when: str
    why: str
    installed: Installed
    metrics: ChampionMetrics | None = None
    lineage: Lineage = Lineage()
    since: str = ""
    contestant: str = ""
    rehearsal: bool = False
    verdict: str = ""

    @property
    def md5(self) -> str:
        """DVC's hash of the whole folder."""
        return self.installed.folder["md5"]

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "Champion":
        metrics = fields.get("metrics")
        return cls(
            fields["run"],
            fields["when"],
            fields.get("why", ""),
            Installed(fields["folder"], fields.get("files", {}), fields.get("outs", {})),
            ChampionMetrics(metrics["panel"], metrics["mean_cost"], metrics["guards"]) if metrics else None,
            Lineage.read(fields.get("lineage", {})),
            fields.get("since", ""),
            fields.get("contestant", ""),
            fields.get("rehearsal", False),
            fields.get("verdict", ""),
        )

    def written(self) -> dict[str, Any]:
        return {
            "run": self.run,
            "when": self.when,
            "why": self.why,
            **self.installed._asdict(),
            "metrics": self.metrics._asdict() if self.metrics else {},
            "lineage": self.lineage.written(),
        } | self._where_set("since", "contestant", "rehearsal", "verdict")

    def _where_set(self, *names: str) -> dict[str, Any]:
        return {name: value for name in names if (value := getattr(self, name))}


class HistoryLine(NamedTuple):
    """One change of production: which loop, what happened, when and why, and the champion from then on.
    `before` is the run of the champion until then, None where there was none. `replaced` are the files of
    the champion that a rollback took out, MD5 by path."""

    run: str
    loop: str
    event: str
    when: str
    why: str
    before: str | None
    champion: Champion
    replaced: Mapping[str, str] | None = None

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "HistoryLine":
        plain = (fields[name] for name in ("run", "loop", "event", "when", "why", "before"))
        return cls(*plain, Champion.read(fields["champion"]), fields.get("replaced"))

    def written(self) -> dict[str, Any]:
        fields = self._asdict() | {"champion": self.champion.written()}
        if self.replaced is None:
            del fields["replaced"]
        return fields


class ChampionState(NamedTuple):
    """champion.json: {loop: champion}, and every change of production, the oldest first. `candidates`: of
    each loop the last challenger that did not pass the page's rules; its files lie in
    champion/<loop>.candidate, and nothing runs them."""

    champions: Mapping[str, Champion] = {}
    history: tuple[HistoryLine, ...] = ()
    candidates: Mapping[str, Champion] = {}

    @property
    def folders(self) -> dict[str, Champion]:
        """What lies below champion/, by folder."""
        return {**self.champions, **{candidate_of(loop): one for loop, one in self.candidates.items()}}

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "ChampionState":
        """Raises ValueError where the file lacks a field that production cannot be known without."""
        try:
            champions = {loop: Champion.read(entry) for loop, entry in fields["champions"].items()}
            candidates = {
                loop: Champion.read(entry) for loop, entry in (fields.get("candidates") or {}).items()
            }
            return cls(champions, tuple(map(HistoryLine.read, fields["history"])), candidates)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                "champion.json: expected champions and history, each with run, when and folder, "
                f"found no {error}; take the file of the last good commit (git log champion.json)"
            ) from None

    def written(self) -> dict[str, Any]:
        candidates = {loop: candidate.written() for loop, candidate in self.candidates.items()}
        return {
            "schema": "champion",
            "version": 1,
            "champions": {loop: champion.written() for loop, champion in self.champions.items()},
            "history": [line.written() for line in self.history],
        } | ({"candidates": candidates} if candidates else {})
