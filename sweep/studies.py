"""The studies that a store knows: their grids, and the trials of both stages as they can be trained again."""

from collections.abc import Iterable

from sweep.grid import Grid, parse
from sweep.messages import UserError, suggestion
from sweep.selections import read_selection
from sweep.store import Store
from sweep.trials import Trial, evaluation_trials, expand

_SHORTEST = 4


def grid_of(store: Store, study: str) -> Grid:
    """Return the grid of a study as it was launched last. Raises UserError for a study that the store does not know."""
    text, overrides = store.study_source(study)
    return parse(text, str(store.path / "studies" / study / "grid.toml"), overrides)


def stages_of(store: Store, grid: Grid) -> dict[str, list[Trial]]:
    """Return the trials of a study by stage; those of the evaluation stage once the settings are chosen."""
    stages = {"tune": expand(grid)}
    frozen = read_selection(store, grid.name)
    if frozen is not None and grid.evaluate_seeds:
        stages["evaluate"] = evaluation_trials(grid, frozen.chosen())
    return stages


def trials_of(store: Store) -> dict[str, Trial]:
    """Return all trials of all studies by their names."""
    stages = (stages_of(store, grid_of(store, study)) for study in store.studies())
    return {trial.id: trial for known in stages for trials in known.values() for trial in trials}


def named(store: Store, study: str | None) -> list[str]:
    """Return the studies that a name means: all of them when there is none. A built-in study may go by its built-in name."""
    known = store.studies()
    if study is None:
        return known
    for name in (study, study.removeprefix("thesis/").replace("/", "-").replace(".", "-")):
        if name in known:
            return [name]
    if not known:
        raise UserError(f"{store.path}: there is no study in this store yet; `sweep launch` brings one")
    raise UserError(f'unknown study "{study}"; {suggestion(study, known)}')


def find_trial(store: Store, name: str, studies: Iterable[str] | None = None) -> tuple[str, Trial]:
    """Return a study and a trial of it, by its name or the beginning of it. Raises UserError when there is none, or several."""
    found: dict[str, tuple[str, Trial]] = {}
    for study in studies if studies is not None else store.studies():
        if len(name) >= _SHORTEST and any(trial.startswith(name) for trial in store.study_trials(study)):
            for trials in stages_of(store, grid_of(store, study)).values():
                found |= {trial.id: (study, trial) for trial in trials if trial.id.startswith(name)}
    if len(found) > 1:
        raise UserError(f'"{name}" is the beginning of {len(found)} trials: {", ".join(sorted(found)[:3])}, …')
    if not found:
        raise UserError(f'"{name}": no study in {store.path} has such a trial; `sweep failures` lists those that failed')
    return next(iter(found.values()))
