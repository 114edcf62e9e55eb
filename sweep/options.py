"""The options that several commands share."""

import importlib.util
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sweep.messages import UserError
from sweep.sample import find

if TYPE_CHECKING:
    from cluster.executor import Executor

DEFAULT_STORE = Path("results")


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


StoreOption = Annotated[Path, typer.Option("--store", envvar="SWEEP_STORE", help="Folder of results.")]
ReadStoreOption = Annotated[
    Path,
    typer.Option(
        "--store", envvar="SWEEP_STORE", callback=find, help='Folder of results; "sample": runs that come with the package.'
    ),
]
GridArgument = Annotated[
    str, typer.Argument(metavar="GRID", help="A grid file, or a built-in study, such as quickstart or thesis/chapter-6.")
]
ExecutorOption = Annotated[ExecutorName, typer.Option(help="Where to train.")]
AddressOption = Annotated[str | None, typer.Option(help="Address of a running Ray cluster; default: a Ray of its own.")]
NumCpusOption = Annotated[int | None, typer.Option(min=1, help="Workers on this machine; default: all cores.")]
ThreadsOption = Annotated[int, typer.Option(min=1, help="Threads a worker.")]
DeviceOption = Annotated[Device, typer.Option(help="Where tensors live; auto takes a GPU if there is one.")]
Tf32Option = Annotated[bool, typer.Option("--tf32", help="On a GPU: faster, rounded matrix products.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
CheckpointOption = Annotated[
    float, typer.Option("--checkpoint-every", metavar="SECONDS", min=0.1, help="Training time between checkpoints of a shard.")
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="PATH=VALUE", help="Change a value of the grid, such as study.steps=500.")
]


def executor_starter(
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
