"""How far the studies of a store are, read off its files: what is planned, finished, failed, and what launches say of themselves.

It needs neither a database nor the launch, and may be asked from any machine that sees the files.
"""

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from sweep import launches
from sweep.shard_files import read_table
from sweep.store import Store

_COUNTS = ("finished", "diverged", "failed", "running", "missing")


@dataclass(frozen=True)
class GroupStatus:
    """Numbers of trials of an agent on an environment in one stage: planned is the sum of the others."""

    stage: str
    agent: str
    environment: str
    planned: int
    finished: int
    diverged: int
    failed: int
    running: int
    missing: int

    @property
    def done(self) -> int:
        """Trials that are in the store."""
        return self.finished + self.diverged


@dataclass(frozen=True)
class StudyStatus:
    """A study, by stage, agent and environment, and the launches that train for it now (their heartbeats)."""

    study: str
    groups: tuple[GroupStatus, ...]
    launches: tuple[Mapping[str, Any], ...]

    def count(self, name: str) -> int:
        """Return the sum of a column over all groups: planned, done, finished, diverged, failed, running or missing."""
        return sum(getattr(group, name) for group in self.groups)

    @property
    def agent_steps_per_second(self) -> float:
        """What all launches together train."""
        return float(sum(one.get("agent_steps_per_second") or 0.0 for one in self.launches))

    @property
    def eta_seconds(self) -> float | None:
        """Seconds until the last of the launches is done with its stage; None when none runs or none knows yet."""
        times = [one.get("eta_seconds") for one in self.launches]
        known = [seconds for seconds in times if seconds is not None]
        return max(known) if known and len(known) == len(times) else None

    def to_json(self) -> dict[str, Any]:
        """Return the status as values that JSON knows."""
        return {
            "study": self.study,
            "trials": self.count("planned"),
            **{name: self.count(name) for name in _COUNTS},
            "agent_steps_per_second": round(self.agent_steps_per_second, 1),
            "eta_seconds": self.eta_seconds,
            "groups": [
                {"stage": group.stage, "agent": group.agent, "environment": group.environment, "trials": group.planned}
                | {name: getattr(group, name) for name in _COUNTS}
                for group in self.groups
            ],
            "launches": [{name: value for name, value in one.items() if name != "trials"} for one in self.launches],
        }


def status(store: Store, studies: Collection[str]) -> list[StudyStatus]:
    """Return the status of these studies, in this order. Raises UserError for files that are damaged."""
    known = _statuses(store)
    failed = {trial["trial"] for failure in store.failures() for trial in failure.trials}
    alive = launches.under_way(store.path)
    running = {trial for one in alive for trial in one.get("trials", ())}
    found = []
    for study in studies:
        counts: dict[tuple[str, str, str], Counter[str]] = {}
        for stage, agent, environment, trial in _members(store, study):
            state = known.get(trial) or ("running" if trial in running else "failed" if trial in failed else "missing")
            counts.setdefault((stage, agent, environment), Counter())[state] += 1
        groups = tuple(
            GroupStatus(*key, counter.total(), *(counter[name] for name in _COUNTS)) for key, counter in counts.items()
        )
        own = tuple(one for one in alive if one.get("study") == study)
        found.append(StudyStatus(study, groups, own))
    return found


def _statuses(store: Store) -> dict[str, str]:
    """Return trial → finished or diverged for all trials in the store."""
    found: dict[str, str] = {}
    for folder in store.shards():
        table = read_table(folder / "trials.parquet", ["trial", "status"])
        found.update(zip(table["trial"].to_pylist(), table["status"].to_pylist(), strict=True))
    return found


def _members(store: Store, study: str) -> list[tuple[str, str, str, str]]:
    file = store.path / "studies" / study / "members.parquet"
    if not file.exists():
        return []
    columns = ["stage", "agent", "environment", "trial"]
    table = read_table(file, columns)
    return list(zip(*(table[name].to_pylist() for name in columns), strict=True))
