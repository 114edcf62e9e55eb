"""When pilots run and what becomes of what they read off. The readings are made up; the pilot itself is tested beside this."""

import json
import os
from dataclasses import replace

import pytest

from agents.hypers import GreedyACHypers, SACHypers
from agents.registry import Algorithm
from cluster import calibration_cache
from cluster.calibration import calibrate, reports
from cluster.executor import InProcessExecutor
from cluster.machine import Machine, calibrations_file, this_machine
from cluster.pilot import Footprint, Reading, footprint, run_pilot
from cluster.worker import Training
from sweep.shards import group_of, pack
from sweep.trials import Trial

MB = 2**20


def trials(count=600, steps=100_000, agent="SAC", environment="Pendulum-CA", hypers=SACHypers()):  # noqa: B008
    return [Trial(agent, environment, hypers, seed, steps, 1000, 0.99) for seed in range(count)]


class Pretending(InProcessExecutor):
    """An executor of any size, whose workers answer at once: `rate` gives agent-steps a second of a population."""

    def __init__(self, slots=2, cores=2, available=2**34, rate=lambda population: 1_000 + population, agent_bytes=MB):
        super().__init__()
        self.slots = self.slots_on_a_machine = slots
        self.machine, self.rate, self.agent_bytes = Machine("here", cores, available), rate, agent_bytes
        self.pilots, self.copies = [], set()

    def gather(self, function, argument, copies):
        if function is this_machine:
            return [self.machine] * copies
        if function is footprint:
            return [Footprint(48, 60 * MB)] * copies
        assert function is run_pilot
        self.pilots.append(argument)
        self.copies.add(copies)
        peak = 300 * MB + argument.population * (self.agent_bytes + 48 * argument.hypers.batch_size)
        return [Reading(self.rate(argument.population), argument.hypers.batch_size, 300 * MB, peak)] * copies

    @property
    def sizes(self):
        """The sizes that were tried after the first one, which only warms up, each once."""
        return sorted({pilot.population for pilot in self.pilots[1:]})


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """The cache's file, in a folder of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "sweep" / "calibrations.json"


def found(executor, members=None, training=Training(), **how):  # noqa: B008
    members = trials() if members is None else members
    known = calibrate(members, executor, training, **how)
    return known.sizes(members).get(group_of(members[0])) if members else None


def found_anew(executor):
    """What is found where nothing was measured before."""
    calibrations_file().unlink(missing_ok=True)
    return found(executor)


def test_a_study_of_minutes_is_not_calibrated_and_takes_the_default():
    executor = Pretending(slots=2)
    quickstart = trials(18, 20_000) + trials(18, 20_000, "GreedyAC", hypers=GreedyACHypers())
    assert calibrate(quickstart, executor, Training()).groups == {}
    assert found(executor, trials(23)) is None  # 23 × 100,000 ÷ (2 × 4,000 a second) = 287 seconds
    assert executor.pilots == []
    assert found(executor, trials(25)) is not None  # 312 seconds
    assert executor.pilots


def test_only_the_groups_that_are_worth_it_are_calibrated():
    executor = Pretending()
    known = calibrate(trials(10) + trials(600, environment="Pendulum-DA"), executor, Training())
    assert [group.environment for group in known.groups] == ["Pendulum-DA"]
    assert {pilot.environment for pilot in executor.pilots} == {"Pendulum-DA"}


def test_a_pilot_trains_the_groups_own_hyperparameters_for_the_device_and_the_threads_of_the_launch():
    executor = Pretending()
    members = trials(hypers=SACHypers(batch_size=7, hidden_layers=(8,)))
    found(executor, members, Training("cpu", threads=3))
    assert {(pilot.hypers, pilot.device, pilot.threads) for pilot in executor.pilots} == {(members[0].hypers, "cpu", 3)}


@pytest.mark.parametrize(
    ("slots", "cores", "count", "copies"), [(2, 8, 600, 2), (64, 8, 9_000, 8), (64, 64, 5, 5), (1, 64, 600, 1)]
)
def test_as_many_pilots_run_at_once_as_shards_will_but_no_more_than_cores(slots, cores, count, copies):
    executor = Pretending(slots, cores)
    found(executor, trials(count), whatever_the_size=True)
    assert executor.copies == {copies}


def test_the_fastest_population_is_found_whatever_its_size():
    assert found_anew(Pretending()).population == 256
    assert found_anew(Pretending(rate=lambda population: 5_000 - population)).population == 16
    assert found_anew(Pretending(rate=lambda population: 5_000 if population == 64 else 4_000)).population == 64


@pytest.mark.parametrize("when", [2, 3])  # the first pilot of the smallest size only warms up
def test_a_disturbance_in_one_of_two_rounds_does_not_decide(when):
    tried = []

    def disturbed(population):
        tried.append(population)
        return 1_000 if population == 16 and tried.count(16) == when else 5_000 - population

    assert found(Pretending(rate=disturbed)).population == 16


def test_sizes_that_would_take_long_or_more_memory_than_there_is_are_not_even_tried(monkeypatch):
    now = [0.0]

    def slow(population):
        now[0] += population * 0.03  # 0.96 s for 32, 1.92 for 64: 128 would take 3.84
        return 100

    with monkeypatch.context() as patch:
        patch.setattr("cluster.calibration.time.monotonic", lambda: now[0])
        executor = Pretending(rate=slow)
        found_anew(executor)
    assert executor.sizes == [16, 32, 64]
    cramped = Pretending(available=2**30)  # 0.4 GB a worker: 300 MB and 1 MB an agent
    found_anew(cramped)
    assert cramped.sizes == [16, 32, 64]


def test_populations_are_as_small_as_the_memory_of_the_machine_demands():
    roomy = found(Pretending(slots=2, available=2**36))
    assert roomy.population == 256
    size = found(Pretending(slots=2, available=2 * 2**30))
    each = MB + 100_000 * 48  # network and replay
    assert 360 * MB + size.population * each < 0.8 * 2**30 < 360 * MB + (size.population + 2) * (each + 100_000)
    assert found(Pretending(slots=4, available=2 * 2**30)).population < size.population / 2


def test_what_was_measured_before_is_not_measured_again_and_serves_small_studies_too(cache):
    first, second = Pretending(), Pretending(rate=lambda population: 1 / 0)
    known = found(first)
    assert cache.exists()
    assert found(second) == known
    assert found(second, trials(4)) == known
    assert second.pilots == []
    assert calibrate(trials(), second, Training()).groups[group_of(trials()[0])].how == "measured before"


@pytest.mark.parametrize(
    "changed", ["agent", "environment", "shared", "threads", "workers", "executor", "host", "engine", "torch"]
)
def test_whatever_speed_depends_on_is_measured_anew_when_it_changes(changed, monkeypatch):
    found(Pretending())
    executor, members, training = Pretending(), trials(), Training()
    match changed:
        case "agent":
            members = trials(agent="GreedyAC", hypers=GreedyACHypers())
        case "environment":
            members = trials(environment="Acrobot-CA")
        case "shared":
            members = trials(hypers=SACHypers(batch_size=33))
        case "threads":
            training = Training(threads=2)
        case "workers":
            executor = Pretending(slots=1)
        case "executor":
            executor.name = "elsewhere"
        case "host":
            executor.machine = replace(executor.machine, host="there")
        case "engine":
            monkeypatch.setenv("SWEEP_ENGINE", "torch")
        case "torch":
            monkeypatch.setattr(calibration_cache.metadata, "version", lambda name: "0.0")
    found(executor, members, training)
    assert executor.pilots


def test_what_is_no_shared_hyperparameter_is_not_measured_anew():
    found(Pretending())
    executor = Pretending()
    found(executor, trials(steps=50_000, hypers=SACHypers(critic_step_size=0.5)))
    assert executor.pilots == []


SPOILED = [
    "",
    "{",
    "[]",
    "null",
    '{"format": 1}',
    '{"format": 1, "calibrations": [1]}',
    '{"format": 2, "calibrations": {}}',
    "\x00",
]


@pytest.mark.parametrize("text", SPOILED)
def test_a_cache_that_is_damaged_is_measured_again_and_mended(cache, text):
    found(Pretending())
    cache.write_text(text)
    executor = Pretending()
    assert found(executor).population == 256
    assert executor.pilots
    assert len(json.loads(cache.read_text())["calibrations"]) == 1


def test_an_entry_that_is_damaged_is_measured_again(cache):
    found(Pretending())
    content = json.loads(cache.read_text())
    (name,) = content["calibrations"]
    for spoiled in (None, {}, {"rates": {"64": "fast"}}, {**content["calibrations"][name], "rates": {}}):
        cache.write_text(json.dumps({"format": 1, "calibrations": {name: spoiled}}))
        executor = Pretending()
        assert found(executor).population == 256
        assert executor.pilots


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "sweep").write_text("in the way")
    for _ in range(2):
        executor = Pretending()
        assert found(executor).population == 256
        assert executor.pilots
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr("pathlib.Path.home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert calibrations_file() is None
    assert found(Pretending()).population == 256


def test_a_relative_cache_folder_is_ignored_as_the_standard_says(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "caches")
    monkeypatch.setenv("HOME", "/home/someone")
    assert str(calibrations_file()) == "/home/someone/.cache/sweep/calibrations.json"


def test_the_cache_keeps_the_newest_and_does_not_grow_forever(cache, monkeypatch):
    monkeypatch.setattr(calibration_cache, "_MOST", 2)
    for batch_size in (3, 4, 5):
        found(Pretending(), trials(hypers=SACHypers(batch_size=batch_size)))
    kept = [json.loads(name)["shared"]["batch_size"] for name in json.loads(cache.read_text())["calibrations"]]
    assert kept == [4, 5]
    assert os.listdir(cache.parent) == ["calibrations.json"]


def test_a_pilot_that_fails_leaves_the_default_and_says_why(cache):
    def broken(population):
        raise ValueError("the user's code\nis broken")

    members, executor = trials(), Pretending(rate=broken)
    known = calibrate(members, executor, Training())
    assert known.sizes(members) == {}
    shards = pack(members, 2, known.sizes(members))
    assert reports(known, shards) == ["SAC on Pendulum-CA: populations of 60, not measured (the pilot failed: is broken)"]
    assert not cache.exists()
    assert found(Pretending(rate=lambda population: None)) is None


def test_a_report_names_the_group_its_populations_and_their_speed():
    members = trials() + trials(hypers=SACHypers(batch_size=64))
    known = calibrate(members, Pretending(rate=lambda population: 4_000), Training())
    lines = reports(known, pack(members, 2, known.sizes(members)))
    assert lines == [
        "SAC on Pendulum-CA, batch_size 32: populations of 16, 4,000 agent-steps/s a worker (measured in 0 s)",
        "SAC on Pendulum-CA, batch_size 64: populations of 16, 4,000 agent-steps/s a worker (measured in 0 s)",
    ]


def test_a_report_warns_when_not_even_one_agent_a_worker_fits():
    members = trials()
    known = calibrate(members, Pretending(available=100 * MB), Training())
    assert "GB of memory, and 0.1 GB are available" in reports(known, pack(members, 2, known.sizes(members)))[1]


def test_functions_are_never_calibrated(monkeypatch):
    function = Algorithm("mine:train", SACHypers, ("continuous",), "mine:train", one_trial=True)
    monkeypatch.setattr("cluster.calibration.find_algorithm", lambda name: function)
    executor = Pretending()
    assert calibrate(trials(), executor, Training(), whatever_the_size=True).groups == {}
    assert executor.pilots == []
