"""`sweep retry` and `sweep run`: training again what failed or was damaged, all of it or one trial in the foreground."""

from typing import TYPE_CHECKING, Annotated

import typer

from sweep.options import (
    DEFAULT_STORE,
    AddressOption,
    CheckpointOption,
    Device,
    DeviceOption,
    ExecutorName,
    ExecutorOption,
    JsonOption,
    NumCpusOption,
    StoreOption,
    Tf32Option,
    ThreadsOption,
    executor_starter,
)

if TYPE_CHECKING:
    from sweep.store import Store


def retry(
    study: Annotated[str | None, typer.Argument(metavar="STUDY", help="A study of the store; default: all of them.")] = None,
    store: StoreOption = DEFAULT_STORE,
    executor: ExecutorOption = ExecutorName.ray,
    address: AddressOption = None,
    num_cpus: NumCpusOption = None,
    threads: ThreadsOption = 1,
    device: DeviceOption = Device.cpu,
    tf32: Tf32Option = False,
    checkpoint_every: CheckpointOption = 300.0,
    as_json: JsonOption = False,
) -> None:
    """Train again the trials that failed, and those whose files are damaged: these are put aside first."""
    from rich.console import Console

    from cluster.progress import Progress
    from cluster.protocol import Outcome, again
    from cluster.worker import Training
    from sweep.commands.launch import finish, report
    from sweep.doctor import check_engine
    from sweep.store import Store
    from sweep.studies import named

    check_engine(device.value, here=address is None)
    opened = Store.open(store)
    studies = named(opened, study)
    progress = Progress(Console(stderr=as_json))
    start = executor_starter("retry", executor, address, num_cpus, progress.tick)
    _put_aside_what_is_damaged(opened)
    training = Training(device.value, threads, None, tf32, checkpoint_every)
    outcome = Outcome(study or "all studies", again(opened, studies, start, progress, training))
    if not outcome.stages:
        typer.echo("Nothing failed, and nothing is damaged.", err=as_json)
    if outcome.stages or as_json:
        report(outcome, as_json)
    finish(outcome)


def _put_aside_what_is_damaged(store: "Store") -> None:
    """Put aside damaged shards, and write down their trials as failed, so that nothing is forgotten if this is cut off.

    Raises UserError, before anything is moved, when something else is damaged.
    """
    import socket

    from sweep.failures import DAMAGED
    from sweep.messages import UserError
    from sweep.studies import trials_of
    from sweep.verification import verify

    found = verify(store, quick=True)
    other = [f"{problem.file}: {problem.what}" for problem in found.problems if not problem.shard]
    if other:
        raise UserError("\n".join(other))
    known = trials_of(store) if found.problems else {}
    for shard in sorted({problem.shard for problem in found.problems}):
        problems = [problem for problem in found.problems if problem.shard == shard]
        names = sorted({trial for problem in problems for trial in problem.trials})
        wanted = [known[name] for name in names if name in known]
        what = "\n".join(f"{problem.file.name}: {problem.what}" for problem in problems)
        if wanted:
            store.record_failure(shard, wanted, DAMAGED, socket.gethostname(), what)
        typer.echo(f"shard {shard} is damaged: put aside in {store.quarantine(shard)}", err=True)
        if len(wanted) < len(names):
            typer.echo(f"{len(names) - len(wanted):,} of its trials belong to no study of this store.", err=True)
        if not names:
            typer.echo("Which trials it held cannot be read: launch the study again to train whatever is missing.", err=True)


def run(
    trial: Annotated[str, typer.Argument(metavar="TRIAL", help="A trial's name, or the beginning of it.")],
    store: StoreOption = DEFAULT_STORE,
    threads: ThreadsOption = 1,
    device: DeviceOption = Device.cpu,
    tf32: Tf32Option = False,
) -> None:
    """Train one trial alone, here, in the foreground, and show what it raises. Its rows are kept if the store lacks them."""
    from rich.console import Console

    from cluster.worker import Training, Work, run_shard
    from sweep.doctor import check_engine
    from sweep.shards import Shard
    from sweep.store import Store
    from sweep.studies import find_trial

    check_engine(device.value, here=True)
    opened = Store.open(store)
    study, found = find_trial(opened, trial)
    values = ", ".join(f"{name} = {value}" for name, value in found.applicable_hypers.items())
    typer.echo(f"{study}: {found.id}, {found.agent} on {found.environment}, seed {found.seed}, {found.steps:,} steps: {values}")
    with Console(stderr=True).status("training"):
        receipt = run_shard(Work(Shard((found,)), str(opened.path.resolve()), Training(device.value, threads, None, tf32)))
    if receipt.error is not None:
        typer.echo(receipt.error.rstrip(), err=True)
        raise typer.Exit(2)
    typer.echo("It diverged." if receipt.diverged else "It finished.")
    typer.echo("Its rows are in the store now." if receipt.committed else "The store has its rows already: nothing was written.")
