"""A small study for reports, with scores that are easily worked out by hand."""

from synthetic_store import SyntheticStore

from analysis import connect
from analysis.report_facts import gather
from sweep.store import Store

COMMIT = "0123456789abcdef0123456789abcdef01234567"
VERSIONS = '{"sweep-rl": "0.1.0", "torch": "2.13.0"}'
PROVENANCE = {"commit": COMMIT, "versions": VERSIONS, "host": "box", "device": "cpu", "engine": "native", "wall_seconds": 3600.0}
#: Environment → critic step-size → the return of every episode. Thesis scores: 0.5, 0.75, 1 and −9, −4, 1: spreads 0.5 and 10.
RETURNS = {
    "Pendulum-CA": {1e-3: 50.0, 1e-2: 75.0, 1e-1: 100.0},
    "MountainCar-CA": {1e-3: -1100.0, 1e-2: -600.0, 1e-1: -100.0},
}


def write(path, tune=2, evaluate=3, environments=tuple(RETURNS), **columns):
    """Write a study "demo": SAC with three critic step-sizes, of which the largest is the best one and was evaluated."""
    store = SyntheticStore(path)
    columns = PROVENANCE | columns
    for environment in environments:
        for x, value in RETURNS[environment].items():
            for seed in range(tune):
                store.finish(store.plan("demo", "SAC", environment, seed, critic_step_size=x), [value, value], **columns)
        for seed in range(tune, tune + evaluate):
            planned = store.plan("demo", "SAC", environment, seed, "evaluate", critic_step_size=1e-1)
            store.finish(planned, [RETURNS[environment][1e-1]], **columns)
    return store


def facts_of(path, study="demo"):
    connection = connect(path)
    try:
        return gather(connection, Store.open(path), study)
    finally:
        connection.close()
