"""Kill anything, launch again: the store ends up as if nothing had happened, row for row."""

import random
import subprocess

import pytest
from chaos import GRID, Chaos, command, contents, environment

from sweep.store import Store
from sweep.verification import verify


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """What the study leaves behind when nobody kills anything."""
    folder = tmp_path_factory.mktemp("undisturbed")
    (folder / "grid.toml").write_text(GRID)
    launch = command("launch", "grid.toml", "--store", "store", "--executor", "in-process")
    subprocess.run(launch, cwd=folder, env=environment(), check=True, capture_output=True)
    return contents(folder / "store")


def survive(folder, undisturbed, seed, kills):
    chaos = Chaos(folder, seed, kills)
    try:
        rounds = 0
        while chaos.left:
            rounds += 1
            store = folder / f"store-{rounds}"
            chaos.run(store)
            assert contents(store) == undisturbed, f"seed {seed}, round {rounds}, killed {chaos.killed}"
            assert not verify(Store.open(store)).problems
    finally:
        chaos.clean_up()
    print(f"seed {seed}: {sum(chaos.killed.values())} kills ({chaos.killed}) in {chaos.launches} launches, {rounds} studies")


@pytest.mark.cluster
def test_fifty_kills_of_workers_raylet_head_and_driver_change_no_row(tmp_path, undisturbed):
    survive(tmp_path, undisturbed, random.SystemRandom().randrange(2**32), 50)


@pytest.mark.slow
def test_two_hundred_kills_change_no_row(tmp_path, undisturbed):
    survive(tmp_path, undisturbed, random.SystemRandom().randrange(2**32), 200)
