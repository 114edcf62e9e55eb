"""The whole protocol of a study: tune, select, evaluate the chosen settings on fresh seeds; whatever is missing of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from agents.hypers import Hypers
from cluster.executor import Executor
from cluster.launch import Confirm, Launch
from cluster.progress import Progress
from cluster.summary import Summary
from cluster.worker import Training
from sweep import selections
from sweep.grid import Grid
from sweep.messages import UserError
from sweep.selection import IncompleteError, select
from sweep.store import Store
from sweep.studies import grid_of, stages_of
from sweep.tables import members_table
from sweep.trials import Trial, evaluation_trials, expand, most_evaluation_trials

#: An agent, an environment, and the hyperparameters chosen for it there.
Chosen = tuple[str, str, Hypers]


@dataclass
class Outcome:
    """What became of a study: a summary for each stage that was reached, and what there is to say of the selection.

    `open_stages` are those that could not begin yet.
    """

    study: str
    stages: list[Summary] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)
    open_stages: list[str] = field(default_factory=list)

    def total(self, name: str) -> Any:
        """Return the sum of a number over the stages."""
        return sum(getattr(stage, name) for stage in self.stages)

    @property
    def interrupted(self) -> bool:
        """Whether somebody stopped it, or something did."""
        return any(stage.interrupted or stage.store_is_unwritable or stage.trouble for stage in self.stages)

    @property
    def is_complete(self) -> bool:
        """Whether all trials of all stages are in the store."""
        return not self.open_stages and self.total("finished") == self.total("trials")

    def to_json(self) -> dict[str, Any]:
        """Return the outcome as values that JSON knows: sums over the stages, then each of them."""
        return {
            "study": self.study,
            **_numbers(self),
            "peak_memory_bytes": max((stage.peak_memory for stage in self.stages), default=0),
            "stages": [{"stage": stage.stage, **_numbers(_One(stage))} for stage in self.stages],
            "open_stages": self.open_stages,
            "messages": self.messages,
        }


@dataclass
class _One:
    stage: Summary

    def total(self, name: str) -> Any:
        return getattr(self.stage, name)


def _numbers(outcome: Outcome | _One) -> dict[str, Any]:
    counts = ("trials", "finished", "trained", "diverged", "failed", "agent_steps")
    seconds, steps = outcome.total("seconds"), outcome.total("agent_steps")
    return {
        **{name: outcome.total(name) for name in counts},
        "seconds": round(seconds, 3),
        "agent_steps_per_second": round(steps / seconds, 1) if steps else 0.0,
    }


def run(
    grid: Grid,
    store: Store,
    start_executor: Callable[[], Executor],
    progress: Progress,
    training: Training,
    *,
    confirm: Confirm | None = None,
    allow_partial: bool = False,
) -> Outcome:
    """Train whatever a study needs and the store lacks, stage by stage, with one executor.

    The evaluation stage begins when all tuning trials are there, or, with `allow_partial`, with the settings that have all their
    seeds. Choices once made stay, as long as the tuning trials and [select] are the same.
    """
    tuning = expand(grid)
    outcome = Outcome(grid.name)
    frozen = _frozen(grid, store, tuning)
    _write(grid, store, tuning, frozen or [])
    with Launch(grid.name, store, start_executor, progress, training, confirm) as launch:
        outcome.stages.append(launch.train("tune", tuning))
        if not grid.evaluate_seeds:
            return outcome
        chosen = None if launch.interrupted else _chosen(grid, store, tuning, frozen, allow_partial, outcome)
        if not chosen:
            outcome.open_stages.append("evaluate")
            return outcome
        if chosen != frozen:
            _write(grid, store, tuning, chosen)
        outcome.stages.append(launch.train("evaluate", evaluation_trials(grid, chosen)))
    return outcome


def _chosen(
    grid: Grid, store: Store, tuning: Sequence[Trial], frozen: list[Chosen] | None, allow_partial: bool, outcome: Outcome
) -> list[Chosen] | None:
    """Return what is to be evaluated: what is frozen, or a choice made now; None, and why, where there can be none yet.

    A choice among some of the settings is made again when the others can be compared, too.
    """
    if frozen is not None and not _left_settings_out(store, grid.name):
        return frozen
    try:
        return _choose(grid, store, tuning, allow_partial, outcome)
    except IncompleteError as error:
        outcome.messages += ["The choice that was made among some of the settings stays."] if frozen else str(error).splitlines()
        return frozen
    except UserError as error:
        outcome.messages += str(error).splitlines()
        return None


def again(
    store: Store,
    studies: Sequence[str],
    start_executor: Callable[[], Executor],
    progress: Progress,
    training: Training,
) -> list[Summary]:
    """Train the failed trials of these studies; return a summary for each stage that had any."""
    failed = {trial["trial"] for failure in store.failures() for trial in failure.trials}
    summaries: list[Summary] = []
    for study in studies:
        with Launch(study, store, start_executor, progress, training) as launch:
            for stage, trials in stages_of(store, grid_of(store, study)).items():
                wanted = [trial for trial in trials if trial.id in failed]
                if wanted:
                    summaries.append(launch.train(stage, wanted))
                if launch.interrupted:
                    return summaries
    return summaries


@dataclass(frozen=True)
class Stages:
    """The trials of both stages; `known`: whether those of the second are chosen, else they are the most that there can be."""

    tune: list[Trial]
    evaluate: list[Trial]
    known: bool

    @property
    def trials(self) -> list[Trial]:
        """The trials of both stages, each once."""
        return list({trial.id: trial for trial in (*self.tune, *self.evaluate)}.values())

    def to_json(self) -> dict[str, Any]:
        """Return the numbers of trials as values that JSON knows."""
        return {"tune": {"trials": len(self.tune)}, "evaluate": {"trials": len(self.evaluate), "chosen": self.known}}


def planned(grid: Grid, store: Store | None) -> Stages:
    """Return what a launch would train, finished or not. Raises UserError for a store whose files are damaged."""
    tuning = expand(grid)
    frozen = _frozen(grid, store, tuning) if store is not None else None
    if frozen is None:
        return Stages(tuning, most_evaluation_trials(grid), not grid.evaluate_seeds)
    return Stages(tuning, evaluation_trials(grid, frozen), True)


def _frozen(grid: Grid, store: Store, tuning: Sequence[Trial]) -> list[Chosen] | None:
    """Return the choices in the store, if they are of this grid."""
    known = selections.read_selection(store, grid.name)
    if known is None or not grid.evaluate_seeds or known.basis != selections.basis(grid, tuning):
        return None
    return known.chosen()


def _left_settings_out(store: Store, study: str) -> bool:
    """Whether settings could not be compared when the choice was made: some of their runs were missing, or have no score."""
    frozen = selections.read_selection(store, study)
    return frozen is not None and any(row["num_left_out"] for row in frozen.rows)


def _choose(grid: Grid, store: Store, tuning: Sequence[Trial], allow_partial: bool, outcome: Outcome) -> list[Chosen]:
    """Choose, and freeze the choice, unless the one that is frozen was made from the same."""
    scores, worst = selections.gather_scores(store, tuning, grid.select.score)
    found = select(grid, scores, worst, allow_partial=allow_partial)
    outcome.messages += found.messages
    basis = selections.basis(grid, tuning)
    table = selections.table(grid.name, found.choices, basis, found.normalizer.constants())
    frozen = selections.read_selection(store, grid.name)
    if frozen is None or not frozen.holds(table):
        selections.write_selection(store, grid.name, table)
    return [(choice.agent, choice.environment, choice.hypers) for choice in found.choices]


def _write(grid: Grid, store: Store, tuning: Sequence[Trial], chosen: Sequence[Chosen]) -> None:
    stages = {"tune": tuning}
    if chosen:
        stages["evaluate"] = evaluation_trials(grid, chosen)
    store.write_study(grid.name, grid.text, members_table(grid.name, stages), grid.overrides)
