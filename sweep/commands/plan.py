"""`sweep plan` and `sweep doctor`: what would happen, and on what."""

import json
import os
from typing import Annotated

import typer

from sweep.messages import UserError
from sweep.options import (
    DEFAULT_STORE,
    AddressOption,
    Device,
    DeviceOption,
    ExecutorName,
    ExecutorOption,
    GridArgument,
    JsonOption,
    NumCpusOption,
    ReadStoreOption,
    SetOption,
    Tf32Option,
    ThreadsOption,
    executor_starter,
)


def plan(
    grid: GridArgument,
    store: ReadStoreOption = DEFAULT_STORE,
    executor: ExecutorOption = ExecutorName.ray,
    address: AddressOption = None,
    num_cpus: NumCpusOption = None,
    threads: ThreadsOption = 1,
    device: DeviceOption = Device.cpu,
    tf32: Tf32Option = False,
    set_: SetOption = None,
    pilot: Annotated[bool, typer.Option("--pilot/--no-pilot", help="Measure rates, or take nominal ones.")] = True,
    as_json: JsonOption = False,
) -> None:
    """Say what a launch would do: trials, hours, memory, disk. Writes nothing to the store, which need not exist."""
    from rich.console import Console

    from cluster.planning import plan_launch, plan_nominally
    from cluster.progress import Progress
    from cluster.protocol import planned
    from cluster.worker import Training
    from sweep.doctor import check_engine
    from sweep.grid import load
    from sweep.plan_report import show
    from sweep.store import Store

    study = load(grid, set_ or ())
    stages = planned(study, Store.open_if_any(store))
    trials = stages.trials
    check_engine(device.value, here=address is None)
    training = Training(device.value, threads, tf32=tf32)
    if pilot:
        start = executor_starter("plan", executor, address, num_cpus)
        found = plan_launch(study.name, trials, store, start, training, Progress(Console(stderr=True)))
    else:
        if address is not None:
            raise UserError("plan: --no-pilot asks no cluster: leave out --address, and give its CPUs as --num-cpus")
        slots = 1 if executor is ExecutorName.in_process else num_cpus or os.cpu_count() or 1
        found = plan_nominally(study.name, trials, store, slots, training)
    if as_json:
        typer.echo(json.dumps({**found.to_json(), "stages": stages.to_json()}))
        return
    show(found, Console())
    if stages.evaluate and not stages.known:
        typer.echo(
            f"Of these, {len(stages.evaluate):,} at most are to evaluate: how many it will be, the tuning stage says. "
            "They are planned as if any setting were chosen."
        )


def doctor(as_json: JsonOption = False) -> None:
    """Say which engine trains and why, and what the machine and the installation are."""
    from sweep.doctor import examine, lines

    found = examine()
    for line in [json.dumps(found)] if as_json else lines(found):
        typer.echo(line)
