"""`sweep launch`: the whole study, tuning, selection and evaluation, whatever is missing of it."""

import json
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from sweep.messages import counted
from sweep.options import (
    DEFAULT_STORE,
    AddressOption,
    CheckpointOption,
    Device,
    DeviceOption,
    ExecutorName,
    ExecutorOption,
    GridArgument,
    JsonOption,
    NumCpusOption,
    SetOption,
    StoreOption,
    Tf32Option,
    ThreadsOption,
    executor_starter,
)

if TYPE_CHECKING:
    from cluster.protocol import Outcome
    from cluster.summary import Summary

#: Work of more than this many hours, on all workers together, is asked about.
ASK_HOURS = 1.0


def launch(
    grid: GridArgument,
    store: StoreOption = DEFAULT_STORE,
    executor: ExecutorOption = ExecutorName.ray,
    address: AddressOption = None,
    num_cpus: NumCpusOption = None,
    threads: ThreadsOption = 1,
    device: DeviceOption = Device.cpu,
    tf32: Tf32Option = False,
    limit: Annotated[int | None, typer.Option(min=1, help="Train at most so many trials, then stop.")] = None,
    set_: SetOption = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Ask nothing, however long it takes.")] = False,
    allow_partial: Annotated[
        bool, typer.Option("--allow-partial", help="Select among the settings that have all their seeds.")
    ] = False,
    checkpoint_every: CheckpointOption = 300.0,
    as_json: JsonOption = False,
) -> None:
    """Train whatever a study needs and the store lacks. Run it again after any interruption."""
    from rich.console import Console

    from cluster import protocol
    from cluster.progress import Progress
    from cluster.worker import Training
    from sweep.doctor import check_engine
    from sweep.grid import load
    from sweep.store import Store
    from sweep.trials import expand

    study = load(grid, set_ or ())
    trials = expand(study)
    check_engine(device.value, here=address is None)
    progress = Progress(Console(stderr=as_json))
    start = executor_starter("launch", executor, address, num_cpus, progress.tick)
    if any(trial.steps < trial.cutoff for trial in trials):
        then = " Where none has, nothing can be chosen to evaluate." if study.evaluate_seeds else ""
        typer.echo(
            f"Trials are shorter than the cutoff: an episode that does not terminate by itself has no return to score.{then}",
            err=True,
        )
    opened = Store.create(store)
    dropped = opened.study_trials(study.name, "tune") - {trial.id for trial in trials}
    training = Training(device.value, threads, limit, tf32, checkpoint_every)
    confirm = None if yes or not sys.stdin.isatty() else _confirm
    outcome = protocol.run(study, opened, start, progress, training, confirm=confirm, allow_partial=allow_partial)
    report(outcome, as_json)
    if dropped:
        typer.echo(
            f"{len(dropped):,} trials of the study's earlier grid are no longer part of it; they stay in the store.", err=True
        )
    finish(outcome)


def report(outcome: "Outcome", as_json: bool) -> None:
    """Print what a launch did."""
    if as_json:
        typer.echo(json.dumps(outcome.to_json()))
        return
    for line in _lines(outcome):
        typer.echo(line)


def finish(outcome: "Outcome") -> None:
    """Exit with the code that says how it went, unless all went well."""
    if outcome.total("failed"):
        raise typer.Exit(2)
    if not outcome.is_complete:
        raise typer.Exit(3)


def _confirm(trials: int, hours: float) -> bool:
    from sweep.messages import duration

    if hours < ASK_HOURS:
        return True
    return typer.confirm(f"{trials:,} trials, about {duration(hours * 3600)}. Go on?", default=True, err=True)


def _lines(outcome: "Outcome") -> Sequence[str]:
    if outcome.is_complete and not outcome.total("trained") and not outcome.total("already_there"):
        return [*outcome.messages, f"{outcome.study}: all {outcome.total('trials'):,} trials are finished; nothing to do."]
    lines: list[str] = []
    for number, stage in enumerate(outcome.stages):
        lines += _stage_lines(stage, len(outcome.stages) > 1)
        if number == 0:
            lines += outcome.messages
    if "evaluate" in outcome.open_stages:
        complete = outcome.stages[0].finished == outcome.stages[0].trials
        lines.append(
            "No setting could be chosen, so that none is evaluated."
            if complete and not outcome.interrupted
            else "The evaluation stage begins when all tuning trials are finished."
        )
    return lines


def _stage_lines(stage: "Summary", several: bool) -> list[str]:
    name = f"{stage.study} ({stage.stage})" if several else stage.study
    if stage.finished_before == stage.trials:
        return [f"{name}: all {stage.trials:,} trials were finished."]
    lines = [
        f"{name}: {counted(stage.trained, 'trial')} trained in {stage.seconds:,.0f} s, "
        f"{stage.agent_steps_per_second:,.0f} agent-steps a second; "
        f"{stage.finished:,} of {stage.trials:,} finished."
    ]
    if stage.already_there:
        lines.append(f"{stage.already_there:,} were in the store by then: another launch had trained them.")
    if stage.trouble:
        lines.append(f"Stopped: {stage.trouble}")
    if stage.store_is_unwritable:
        lines.append("Stopped: the store cannot be written to (see the errors above). Make room, then launch again.")
    if stage.diverged:
        lines.append(f"{stage.diverged:,} diverged: their numbers stopped being finite. They are kept, and marked.")
    if stage.failed:
        lines.append(f"{counted(stage.failed, 'trial')} failed: `sweep failures` says why, `sweep retry` tries them again.")
    if stage.interrupted:
        lines.append("Interrupted. What is finished is in the store; launch again to go on.")
    return lines
