"""A small store written straight from `sweep.schema`, with numbers that a test chooses."""

import hashlib
import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from agents.registry import ALGORITHMS
from sweep import schema
from sweep.trials import Trial

STEPS, CUTOFF = 1_000, 500
_WRITING = {"compression": "zstd", "write_page_checksum": True, "store_schema": False}


def digest(*parts: Any) -> str:
    """Return 16 hexadecimal digits that depend on the parts alone."""
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]


@dataclass
class SyntheticStore:
    """Collects trials and writes them as shards of one algorithm, and studies that need them."""

    path: Path
    members: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    shards: int = 0

    def __post_init__(self) -> None:
        self.path.mkdir(parents=True, exist_ok=True)
        (self.path / "sweep-store.json").write_text('{"format": 1}')

    def plan(self, study: str, agent: str, environment: str, seed: int, stage: str = "tune", **hypers: Any) -> dict[str, Any]:
        """Note that a study needs a trial, and return its identity."""
        values = {**ALGORITHMS[agent].hypers().as_dict(), **hypers}
        setting = hypers.pop("setting", None) or digest(agent, values)
        values.pop("setting", None)
        member = {
            "trial": digest(setting, environment, seed, stage),
            "setting": setting,
            "agent": agent,
            "environment": environment,
            "seed": seed,
            "steps": STEPS,
            "hypers": {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()},
        }
        self.members.setdefault(study, []).append({"study": study, "stage": stage, **member})
        return member

    def plan_trial(self, study: str, trial: Trial, stage: str = "tune") -> dict[str, Any]:
        """Note that a study needs a trial of a grid, and return its identity."""
        hypers = {name: list(value) if isinstance(value, tuple) else value for name, value in trial.applicable_hypers.items()}
        columns = {name: getattr(trial, name) for name in ("setting", "agent", "environment", "seed")}
        member = {"trial": trial.id, **columns, "steps": STEPS, "hypers": hypers}
        self.members.setdefault(study, []).append({"study": study, "stage": stage, **member})
        return member

    def finish(
        self,
        member: dict[str, Any],
        returns: Sequence[float],
        endings: Sequence[str] = (),
        lengths: Sequence[int] = (),
        evaluations: Sequence[tuple[int, float]] = (),
        **columns: Any,
    ) -> None:
        """Write a shard with this one trial, its episodes (of equal length and all truncated unless told) and their steps.

        `evaluations`: step and return of each evaluation episode.
        """
        self.finish_together([(member, returns, endings, lengths, evaluations, columns)])

    def finish_together(self, runs: Sequence[tuple[Any, ...]]) -> None:
        """Write a shard with trials of one algorithm; each is what `finish` takes, the last ones may be left out."""
        trials, episodes, evaluations = [], [], []
        for member, returns, *more in runs:
            endings, lengths, evaluated, columns = (*more, *((), (), (), {})[len(more) :])
            trials.append(_trial_row(member, returns, endings, columns))
            episodes += _episode_rows(member, returns, endings, lengths)
            evaluations += _evaluation_rows(member, evaluated)
        folder = self.path / "shards" / f"shard-{self.shards:04d}"
        self.shards += 1
        folder.mkdir(parents=True)
        hypers = {name: value for member, *_ in runs for name, value in member["hypers"].items()}
        _write(trials, schema.with_hypers(schema.TRIALS, hypers), folder / "trials.parquet")
        _write(episodes, schema.EPISODES, folder / "episodes.parquet")
        if evaluations:
            _write(evaluations, schema.EVALUATIONS, folder / "evaluations.parquet")
        steps = [
            {
                "trial": episode["trial"],
                "step": episode["first_step"] + offset,
                "episodic_return": episode["episodic_return"],
            }
            for episode in episodes
            for offset in range(episode["length"])
        ]
        _write(steps, schema.STEPS, folder / "steps.parquet")

    def write_studies(self) -> Path:
        """Write the members of every study and return the store's path."""
        for study, members in self.members.items():
            hypers = {name: value for member in members for name, value in member["hypers"].items()}
            folder = self.path / "studies" / study
            folder.mkdir(parents=True, exist_ok=True)
            rows = [{**dict.fromkeys(hypers), **member, **member["hypers"]} for member in members]
            _write(rows, schema.with_hypers(schema.MEMBERS, hypers), folder / "members.parquet")
        return self.path


def build(path: Path) -> Path:
    """Study "demo": 3 seeds a setting. The comments give mean returns; X is a diverged trial, - a missing one."""
    store = SyntheticStore(path)

    def plan(agent: str, environment: str, setting: str, x: float, entropy_scale: float, kappa: float = 1.0) -> list[dict]:
        hypers = {"critic_step_size": x, "entropy_scale": entropy_scale, "actor_step_size_scale": kappa, "setting": setting * 16}
        return [store.plan("demo", agent, environment, seed, **hypers) for seed in range(3)]

    a = plan("GreedyAC", "Pendulum-CA", "a", 1e-3, 0.1)  # 20, 30, 40
    store.finish(a[0], [10, 30, 999], ["truncated", "terminated", "budget"])
    store.finish(a[1], [40, 20, -999], ["truncated", "truncated", "budget"])
    store.finish(a[2], [50, 30], evaluations=[(500, 40), (500, 50), (1000, 60)])
    b = plan("GreedyAC", "Pendulum-CA", "b", 1e-3, 0.1, kappa=0.1)  # 20, X, -
    store.finish(b[0], [5, 35])
    store.finish(b[1], [-100, math.nan])
    plan("GreedyAC", "Pendulum-CA", "c", 1e-3, 1.0)  # -, -, -
    d = plan("GreedyAC", "Pendulum-CA", "d", 1e-2, 0.1, kappa=0.1)  # 50, -, -
    store.finish(d[0], [50])
    e = plan("GreedyAC", "Pendulum-CA", "e", 1e-2, 0.1)  # 40, 60, -
    store.finish(e[0], [30, 50])
    store.finish(e[1], [60])
    f = plan("GreedyAC", "Pendulum-CA", "f", 1e-2, 1.0)  # 0, 0, 3
    for trial, value in zip(f, (0, 0, 3), strict=True):
        store.finish(trial, [value])
    g = plan("SAC", "Pendulum-CA", "9", 1e-3, 0.1)  # none completed, failed, 60
    store.finish(g[0], [70], ["budget"])
    store.finish(g[1], [], status="failed")
    store.finish(g[2], [60])
    h = plan("SAC", "MountainCar-CA", "8", 1e-3, 0.1)  # X with nothing completed, -, -
    store.finish(h[0], [math.nan])
    chosen = {"critic_step_size": 1e-3, "entropy_scale": 0.1, "actor_step_size_scale": 1.0, "setting": "a" * 16}
    evaluated = store.plan("demo", "GreedyAC", "Pendulum-CA", 3, "evaluate", **chosen)
    store.finish(evaluated, [60])
    return store.write_studies()


def _trial_row(
    member: dict[str, Any], returns: Sequence[float], endings: Sequence[str], columns: dict[str, Any]
) -> dict[str, Any]:
    endings = endings or ["truncated"] * len(returns)
    completed = [r for r, ending in zip(returns, endings, strict=True) if ending != "budget"]
    diverged = any(math.isnan(r) for r in returns)
    mean = None if diverged or not completed else math.fsum(completed) / len(completed)
    finite = [r for r in completed if math.isfinite(r)]
    return {
        **dict.fromkeys(schema.TRIALS.names),
        **{name: value for name, value in member.items() if name != "hypers"},
        **member["hypers"],
        "cutoff": CUTOFF,
        "discount": 0.99,
        "episodes": len(returns),
        "status": "diverged" if diverged else "finished",
        "episode_mean": mean,
        "step_mean": mean,
        "final_mean": mean,
        "best_episode": max(finite, default=None),
        "worst_episode": min(finite, default=None),
        "wall_seconds": 1.0,
        "population": 1,
        "finished_at": datetime(2026, 1, 1, tzinfo=UTC),
        **columns,
    }


def _episode_rows(
    member: dict[str, Any], returns: Sequence[float], endings: Sequence[str], lengths: Sequence[int]
) -> list[dict[str, Any]]:
    endings = endings or ["truncated"] * len(returns)
    lengths = lengths or [STEPS // max(1, len(returns))] * len(returns)
    first_steps = itertools.accumulate(lengths, initial=1)
    return [
        {
            "trial": member["trial"],
            "episode": index,
            "first_step": first_step,
            "length": length,
            "episodic_return": value,
            "ending": ending,
        }
        for index, (first_step, length, value, ending) in enumerate(zip(first_steps, lengths, returns, endings, strict=False))
    ]


def _evaluation_rows(member: dict[str, Any], evaluations: Sequence[tuple[int, float]]) -> list[dict[str, Any]]:
    counts: dict[int, int] = {}
    rows = []
    for step, value in evaluations:
        counts[step] = counts.get(step, -1) + 1
        row = {"trial": member["trial"], "step": step, "episode": counts[step], "length": CUTOFF}
        rows.append({**row, "episodic_return": value, "ending": "truncated"})
    return rows


def _write(rows: list[dict[str, Any]], columns: pa.Schema, file: Path) -> None:
    pq.write_table(pa.Table.from_pylist(rows, schema=columns), file, **_WRITING)
