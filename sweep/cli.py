"""The command line: translates and reports, nothing else. Imports lazily, so that `sweep --help` answers at once.

Exit codes: 0 done, 1 usage or bad input, 2 some trials failed, 3 incomplete or interrupted.
"""

import importlib.util
import json
import os
import sys
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sweep.messages import UserError

if TYPE_CHECKING:
    from cluster.executor import Executor
    from cluster.launch import Summary

app = typer.Typer(
    help="Hyperparameter sweeps and sensitivity analysis for reinforcement-learning research.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

StoreOption = Annotated[Path, typer.Option("--store", envvar="SWEEP_STORE", help="Folder of results.")]
_DEFAULT_STORE = Path("results")


class ExecutorName(StrEnum):
    """Where training runs."""

    ray = "ray"
    in_process = "in-process"


class Device(StrEnum):
    """Where tensors live."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Format(StrEnum):
    """How the answer to a query is written."""

    table = "table"
    csv = "csv"
    json = "json"
    markdown = "markdown"
    parquet = "parquet"


GridArgument = Annotated[str, typer.Argument(metavar="GRID", help="A grid file, or the name of a built-in study (quickstart).")]
ExecutorOption = Annotated[ExecutorName, typer.Option(help="Where to train.")]
AddressOption = Annotated[str | None, typer.Option(help="Address of a running Ray cluster; default: a Ray of its own.")]
NumCpusOption = Annotated[int | None, typer.Option(min=1, help="Workers on this machine; default: all cores.")]
ThreadsOption = Annotated[int, typer.Option(min=1, help="Threads a worker.")]
DeviceOption = Annotated[Device, typer.Option(help="Where tensors live; auto takes a GPU if there is one.")]


Tf32Option = Annotated[bool, typer.Option("--tf32", help="On a GPU: faster, rounded matrix products.")]


@app.callback()
def _root() -> None:
    pass


@app.command()
def launch(
    grid: GridArgument,
    store: StoreOption = _DEFAULT_STORE,
    executor: ExecutorOption = ExecutorName.ray,
    address: AddressOption = None,
    num_cpus: NumCpusOption = None,
    threads: ThreadsOption = 1,
    device: DeviceOption = Device.cpu,
    tf32: Tf32Option = False,
    limit: Annotated[int | None, typer.Option(min=1, help="Train at most so many trials, then stop.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Train whatever a study needs and the store lacks. Run it again after any interruption."""
    from rich.console import Console

    import cluster.launch
    from cluster.progress import Progress
    from cluster.worker import Training
    from sweep.doctor import check_engine
    from sweep.grid import load
    from sweep.store import Store
    from sweep.tables import members_table
    from sweep.trials import expand

    study = load(grid)
    trials = expand(study)
    check_engine(device.value)
    progress = Progress(Console(stderr=as_json))
    start = _executor_starter("launch", executor, address, num_cpus, progress.tick)
    if study.steps < min(trial.cutoff for trial in trials):
        typer.echo(
            "Trials are shorter than the cutoff: an episode that does not terminate by itself has no return to score.", err=True
        )
    opened = Store.create(store)
    dropped = opened.study_trials(study.name) - {trial.id for trial in trials}
    opened.write_study(study.name, study.text, members_table(study.name, "tune", trials))
    training = Training(device.value, threads, limit, tf32)
    summary = cluster.launch.launch(study.name, trials, opened, start, progress, training)
    if as_json:
        typer.echo(json.dumps(_summary_json(summary)))
    else:
        for line in _summary_lines(summary):
            typer.echo(line)
    if dropped:
        typer.echo(
            f"{len(dropped):,} trials of the study's earlier grid are no longer part of it; they stay in the store.", err=True
        )
    if study.evaluate_seeds:
        typer.echo("Only the tuning stage is run by this version: the evaluation seeds are not used yet.", err=True)
    if summary.failed:
        raise typer.Exit(2)
    if summary.finished < summary.trials:
        raise typer.Exit(3)


def _executor_starter(
    command: str, executor: ExecutorName, address: str | None, num_cpus: int | None, on_progress: Callable[[], None] | None = None
) -> "Callable[[], Executor]":
    """Return what starts the executor that the options name. Raises for options that cannot be, before anything is written."""
    from cluster.executor import Executor, InProcessExecutor

    if address is not None:
        if num_cpus is not None or executor is not ExecutorName.ray:
            raise UserError(f"{command}: --address is for a Ray cluster that runs already: leave out --num-cpus and --executor")
        from cluster.ray_executor import check_address

        check_address(address)
    if executor is ExecutorName.ray and importlib.util.find_spec("ray") is None:
        raise ModuleNotFoundError(name="ray")

    def start() -> Executor:
        if executor is ExecutorName.in_process:
            return InProcessExecutor(on_progress)
        from cluster.ray_executor import RayExecutor

        return RayExecutor(address, num_cpus)

    return start


@app.command()
def plan(
    grid: GridArgument,
    store: StoreOption = _DEFAULT_STORE,
    executor: ExecutorOption = ExecutorName.ray,
    address: AddressOption = None,
    num_cpus: NumCpusOption = None,
    threads: ThreadsOption = 1,
    device: DeviceOption = Device.cpu,
    tf32: Tf32Option = False,
    pilot: Annotated[bool, typer.Option("--pilot/--no-pilot", help="Measure rates, or take nominal ones.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print the plan as JSON.")] = False,
) -> None:
    """Say what a launch would do: trials, hours, memory, disk. Writes nothing to the store, which need not exist."""
    from rich.console import Console

    from cluster.planning import plan_launch, plan_nominally
    from cluster.progress import Progress
    from cluster.worker import Training
    from sweep.doctor import check_engine
    from sweep.grid import load
    from sweep.plan_report import show
    from sweep.trials import expand

    study = load(grid)
    trials = expand(study)
    check_engine(device.value)
    training = Training(device.value, threads, tf32=tf32)
    if pilot:
        start = _executor_starter("plan", executor, address, num_cpus)
        found = plan_launch(study.name, trials, store, start, training, Progress(Console(stderr=True)))
    else:
        if address is not None:
            raise UserError("plan: --no-pilot asks no cluster: leave out --address, and give its CPUs as --num-cpus")
        slots = 1 if executor is ExecutorName.in_process else num_cpus or os.cpu_count() or 1
        found = plan_nominally(study.name, trials, store, slots, training)
    if as_json:
        typer.echo(json.dumps(found.to_json()))
    else:
        show(found, Console())


@app.command()
def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print what was found as JSON.")] = False) -> None:
    """Say which engine trains and why, and what the machine and the installation are."""
    from sweep.doctor import examine, lines

    found = examine()
    for line in [json.dumps(found)] if as_json else lines(found):
        typer.echo(line)


def _summary_json(summary: "Summary") -> dict[str, object]:
    return {
        "study": summary.study,
        "trials": summary.trials,
        "finished": summary.finished,
        "trained": summary.trained,
        "diverged": summary.diverged,
        "failed": summary.failed,
        "agent_steps": summary.agent_steps,
        "seconds": round(summary.seconds, 3),
        "agent_steps_per_second": round(summary.agent_steps_per_second, 1),
        "peak_memory_bytes": summary.peak_memory,
    }


def _summary_lines(summary: "Summary") -> list[str]:
    if summary.finished_before == summary.trials:
        return [f"{summary.study}: all {summary.trials:,} trials are finished; nothing to do."]
    lines = [
        f"{summary.study}: {summary.trained:,} trials trained in {summary.seconds:,.0f} s, "
        f"{summary.agent_steps_per_second:,.0f} agent-steps a second; "
        f"{summary.finished:,} of {summary.trials:,} finished."
    ]
    if summary.already_there:
        lines.append(f"{summary.already_there:,} were in the store by then: another launch had trained them, too.")
    if summary.store_is_unwritable:
        lines.append("Stopped: the store cannot be written to (see the errors above). Make room, then launch again.")
    if summary.diverged:
        lines.append(f"{summary.diverged:,} diverged: their numbers stopped being finite. They are kept, and marked.")
    if summary.failed:
        lines.append(f"{summary.failed:,} trials failed; why is in the store's folder failures. Launch again to try them again.")
    if summary.interrupted:
        lines.append("Interrupted. What is finished is in the store; launch again to go on.")
    return lines


@app.command()
def sql(
    query: Annotated[str | None, typer.Argument(metavar="QUERY", help="A SELECT; default: read it from standard input.")] = None,
    store: StoreOption = _DEFAULT_STORE,
    format: Annotated[Format, typer.Option(help="How to write the answer.")] = Format.table,
) -> None:
    """Query a store's tables and views, read-only."""
    from analysis.query import run
    from sweep.store import Store

    run(Store.open(store).path, sys.stdin.read() if query is None else query, format.value)


@app.command()
def analyze(
    figure: Annotated[str | None, typer.Option(help="A figure by its number, such as 7.1.")] = None,
    list_: Annotated[bool, typer.Option("--list", help="List the figures.")] = False,
    study: Annotated[str | None, typer.Option(help="The study to draw; default: the only one with the data.")] = None,
    store: StoreOption = _DEFAULT_STORE,
    out: Annotated[Path, typer.Option(help="Folder for the files.")] = Path("."),
    format: Annotated[str, typer.Option(help="png, svg, pdf, csv; several with commas.")] = "png",
) -> None:
    """Draw a figure from a store."""
    from analysis import analyze as analysis
    from sweep.store import Store

    if list_:
        for line in analysis.list_figures():
            typer.echo(line)
        return
    if figure is None:
        raise UserError("analyze: say which figure: --figure 7.1 (--list names them all)")
    formats = [part.strip() for part in format.split(",")]
    result = analysis.analyze(Store.open(store).path, figure, study, out, formats)
    for note in result.notes:
        typer.echo(note)
    for file in result.files:
        typer.echo(f"wrote {file}")


# What typer raises for a mistake in the arguments: click's exception, or that of the copy of click that typer carries.
_UsageMistake: Any = next(base for base in typer.BadParameter.__mro__ if base.__name__ == "ClickException")


# Packages that a machine which only trains does without, and what to do there instead of installing them.
_WITHOUT = {
    "ray": "train in this process: --executor in-process",
    **dict.fromkeys(("duckdb", "pandas", "matplotlib", "seaborn"), "copy the store, a folder, to a machine that has it"),
}


_INTERRUPTED = 130  # what typer makes of a keyboard interrupt


def _exit_for(error: OSError) -> None:
    """Exit quietly when the reader of our output has had enough, such as head; else say what the system refused."""
    if isinstance(error, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    place = f"{error.filename}: " if error.filename else ""
    typer.echo(f"error: {place}{error.strerror or error}", err=True)
    sys.exit(1)


def main() -> None:
    """Run the command line: a mistake of the user's becomes a message and exit code 1."""
    try:
        code = app(standalone_mode=False)
        if code == _INTERRUPTED:
            raise KeyboardInterrupt
        sys.exit(code if isinstance(code, int) else 0)
    except OSError as error:
        _exit_for(error)
    except ModuleNotFoundError as error:
        if error.name not in _WITHOUT:
            raise
        typer.echo(f"error: {error.name} is not installed here: pip install {error.name}, or {_WITHOUT[error.name]}", err=True)
    except UserError as error:
        typer.echo(f"error: {error}" if "\n" not in str(error) else str(error), err=True)
    except _UsageMistake as error:
        error.show()
    except (typer.Abort, KeyboardInterrupt):
        typer.echo("Interrupted.", err=True)
        sys.exit(3)
    sys.exit(1)
