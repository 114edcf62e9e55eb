"""From a study's trials to a plan: what is missing, and the pilots that say how long it takes. Writes nothing to the store."""

from collections.abc import Callable, Sequence
from pathlib import Path

from agents import kernels
from agents.registry import find_algorithm
from cluster.calibration import Calibrations, by_group, calibrate, pilot_of
from cluster.executor import Executor
from cluster.machine import this_machine
from cluster.pilot import footprint
from cluster.progress import Progress
from cluster.worker import Training
from sweep.calibration import Calibration, nominal
from sweep.disk import episode_lengths
from sweep.plan import Basis, Plan, Slots, plan
from sweep.shards import pack
from sweep.store import Store
from sweep.trials import Trial


def plan_launch(
    study: str,
    trials: Sequence[Trial],
    store: Path,
    start_executor: Callable[[], Executor],
    training: Training,
    progress: Progress,
) -> Plan:
    """Return the plan of a launch where the executor runs shards, with pilots; it is started only when trials are missing.

    The store need not exist. Raises UserError when the folder is there and is not a store, or cannot be read.
    """
    missing = _missing(trials, store)
    if not missing:
        return _planned(study, trials, missing, store, Calibrations({}), Slots(1, 1, 1), training)
    executor = start_executor()
    try:
        with progress.preparing() as say:
            calibrations = calibrate(missing, executor, training, whatever_the_size=True, say=say)
        (machine,) = [calibrations.machine] if calibrations.machine else executor.gather(this_machine, training.device, 1)
        slots = Slots(executor.slots, executor.slots_on_a_machine, machine.cores, machine.available_bytes)
    finally:
        executor.close()
    return _planned(study, trials, missing, store, calibrations, slots, training)


def plan_nominally(study: str, trials: Sequence[Trial], store: Path, slots: int, training: Training) -> Plan:
    """Return the plan of a launch with this many slots on this machine, without a pilot. Raises UserError as `plan_launch`."""
    machine = this_machine(training.device)
    known = Slots(slots, slots, machine.cores, machine.available_bytes)
    return _planned(study, trials, _missing(trials, store), store, Calibrations({}), known, training)


def _missing(trials: Sequence[Trial], folder: Path) -> list[Trial]:
    store = Store.open_if_any(folder)
    finished = store.finished_trials() if store else set()
    return [trial for trial in trials if trial.id not in finished]


def _planned(
    study: str,
    trials: Sequence[Trial],
    missing: Sequence[Trial],
    store: Path,
    calibrations: Calibrations,
    slots: Slots,
    training: Training,
) -> Plan:
    bases = {}
    for group, members in by_group(missing).items():
        known = calibrations.groups.get(group)
        if known is not None and known.calibration is not None:
            bases[group] = Basis(known.calibration, known.how)
        else:
            bases[group] = Basis(_nominal(members[0], training), f"nominal: {known.how}" if known else "nominal")
    return plan(
        study,
        len(trials),
        pack(missing, slots.count, calibrations.sizes(missing)),
        bases,
        slots,
        kernels.engine_name("cuda" if training.device == "cuda" else "cpu", training.tf32),
        episode_lengths(store),
        training.threads,
    )


def _nominal(trial: Trial, training: Training) -> Calibration:
    if find_algorithm(trial.agent).one_trial:
        return nominal(trial.agent, 0)
    try:
        return nominal(trial.agent, footprint(pilot_of(trial, training)).row_bytes)
    except Exception:  # a user's environment that cannot be made: training will say so
        return nominal(trial.agent, 0)
