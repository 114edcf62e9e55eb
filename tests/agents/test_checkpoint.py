"""A population that was saved and restored goes on as if it had never stopped, bit for bit."""

import contextlib
import random
import subprocess
import sys
import types
from pathlib import Path

import counting_environments
import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from recorded_graph import RecordedGraph

from agents import kernels, records
from agents.checkpoint import CheckpointError
from agents.environments.gymnasium import GymnasiumEnvironment
from agents.evaluation import Evaluation
from agents.hypers import ActorCriticHypers
from agents.networks import PopulationMLP
from agents.registry import ALGORITHMS, ENVIRONMENTS, find_algorithm
from agents.rng import RandomStream
from agents.training import Run

STEPS, CUTOFF, BATCH = 90, 21, 24
SMALL = {"batch_size": BATCH, "replay_capacity": 40, "hidden_layers": (8,)}
# the first step; around an episode's end, before learning; the first update; a replay buffer that has wrapped around; the end
PLACES = (1, CUTOFF - 1, CUTOFF, CUTOFF + 1, BATCH, 47, STEPS - 1)
PAIRS = [
    (algorithm, environment)
    for algorithm in ALGORITHMS
    for environment in ("MountainCar-CA", "Pendulum-DA")
    if ENVIRONMENTS[environment].actions in ALGORITHMS[algorithm].actions
]
COLUMNS = ("agent", "episode", "first_step", "length", "episodic_return", "ending", "diverged_at")


@pytest.fixture(params=["auto", "torch"])
def engine(request):
    """The engine that this machine trains with, and the one in pure torch."""
    with kernels.using(request.param):
        yield


def population(algorithm, count=3, **changes):
    cls = find_algorithm(algorithm).hypers
    rest = {"num_action_samples": 4, "elite_fraction": 0.5}
    rest = {name: value for name, value in rest.items() if name in cls.table}
    return [cls(critic_step_size=10.0 ** -(1 + i), **SMALL, **rest, **changes) for i in range(count)]


def make(algorithm, environment, hypers=None, **arguments):
    hypers = population(algorithm) if hypers is None else hypers
    return Run(algorithm, environment, hypers, [3, 1, 4][: len(hypers)], **{"steps": STEPS, "cutoff": CUTOFF, **arguments})


def copied(state):
    return {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in state.items()}


def saved_at(run, places):
    """Train to the end, and return place → state there."""
    states = {}
    for place in places:
        run.advance(place - run.step)
        states[place] = copied(run.state())
    run.advance(run.steps - run.step)
    return states


def networks_of(thing):
    """Every population network within an algorithm, found by looking into it."""
    if isinstance(thing, PopulationMLP):
        yield thing
    elif type(thing).__module__.startswith("agents."):
        for part in vars(thing).values():
            yield from networks_of(part)


def assert_same(first, second):
    parameters = [[network.parameters for network in networks_of(run._lockstep.agents)] for run in (first, second)]
    assert all(torch.equal(a.nan_to_num(7.0), b.nan_to_num(7.0)) for a, b in zip(*parameters, strict=True))
    assert torch.equal(first._lockstep.observations, second._lockstep.observations)
    one, other = first.finish(), second.finish()
    for a, b in ((one, other), (one.evaluations, other.evaluations)):
        for name in COLUMNS if a is not None else ():
            np.testing.assert_array_equal(getattr(a, name, None), getattr(b, name, None), name)


def check_resumed(*arguments, places=PLACES, **keywords):
    uninterrupted = make(*arguments, **keywords)
    for place, state in saved_at(uninterrupted, places).items():
        resumed = make(*arguments, **keywords)
        resumed.restore(state)
        assert resumed.step == place
        resumed.advance(resumed.steps - place)
        assert_same(uninterrupted, resumed)
    return uninterrupted


@pytest.mark.parametrize(("algorithm", "environment"), PAIRS)
def test_a_resumed_population_equals_an_uninterrupted_one(algorithm, environment, engine):
    uninterrupted = check_resumed(algorithm, environment)
    assert len(list(networks_of(uninterrupted._lockstep.agents))) >= 3
    assert len(set(uninterrupted.finish().length)) > 1


@pytest.mark.parametrize(
    ("algorithm", "changes"),
    [("SAC", {"entropy_tuning": "automatic"}), ("DDPG", {"exploration_noise": "ornstein-uhlenbeck"})],
)
def test_so_does_one_that_keeps_more_than_its_networks(algorithm, changes, engine):
    check_resumed(algorithm, "MountainCar-CA", population(algorithm, **changes))


def test_so_does_one_that_is_evaluated(engine):
    uninterrupted = check_resumed("SAC", "Pendulum-CA", evaluation=Evaluation(20, 2), places=(1, 19, 20, 21, 89))
    assert len(uninterrupted.finish().evaluations.step) == 3 * 4 * 2


@pytest.mark.parametrize("block", [28, 4096])
def test_so_does_one_in_which_an_agent_diverges(block, monkeypatch, engine):
    monkeypatch.setattr(records, "_BLOCK_STEPS", block)
    bad = find_algorithm("SAC").hypers(critic_step_size=1e30, **SMALL)
    uninterrupted = check_resumed("SAC", "Pendulum-CA", [population("SAC")[0], bad])
    diverged_at = uninterrupted.finish().diverged_at
    assert diverged_at[0] == 0 and BATCH <= diverged_at[1] < 47


def test_so_does_a_single_agent():
    check_resumed("SAC", "Pendulum-CA", population("SAC", 1), places=(30,))


@pytest.mark.parametrize("block", [29, 30, 31])
def test_episodes_go_on_across_the_recorders_blocks(block, monkeypatch, engine):
    monkeypatch.setattr(records, "_BLOCK_STEPS", block)
    check_resumed("SAC", "Pendulum-CA", places=(29, 30, 31, 47))


def test_a_state_goes_through_a_file_into_another_process(tmp_path):
    from sweep import checkpoints

    run = make("GreedyAC", "Pendulum-CA")
    run.advance(47)
    checkpoints.save(tmp_path / "file", {}, run.state())
    run.advance(STEPS - 47)
    code = f"""
from pathlib import Path
import torch
torch.set_num_threads(1)
from agents.hypers import GreedyACHypers
from agents.training import Run
from sweep import checkpoints
shared = dict(num_action_samples=4, elite_fraction=0.5, **{SMALL})
hypers = [GreedyACHypers(critic_step_size=10.0 ** -(1 + i), **shared) for i in range(3)]
run = Run("GreedyAC", "Pendulum-CA", hypers, [3, 1, 4], steps={STEPS}, cutoff={CUTOFF})
run.restore(checkpoints.load(Path("file"))[1])
run.advance({STEPS} - run.step)
print(run.finish().episodic_return.tobytes().hex(), run._lockstep.agents.actor.network.parameters.numpy().tobytes().hex())
"""
    root = str(Path(__file__).parents[2])
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {root!r}){code}"]
    printed = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.split()
    parameters = run._lockstep.agents.actor.network.parameters
    assert printed == [x.tobytes().hex() for x in (run.finish().episodic_return, parameters.numpy())]


def test_a_state_is_the_living_memory_and_holds_what_is_filled_of_the_replay_only():
    run = make("SAC", "Pendulum-CA")
    run.advance(10)
    rows = run.state()["lockstep.replay['rows']"]
    assert rows.shape[1] == 10 and np.shares_memory(rows, run._lockstep.replay.rows.numpy())
    before = copied(run.state())
    run.advance(0)
    assert all(np.array_equal(value, before[name]) for name, value in run.state().items())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hypers": population("SAC", polyak=0.5)}, "hypers: "),
        ({"hypers": population("SAC", 2)}, "hypers: "),
        ({"steps": 91}, "steps: 90 in the checkpoint, 91 here"),
        ({"cutoff": 22}, "cutoff: 21 in the checkpoint, 22 here"),
        ({"discount": 0.9}, "discount: 0.99 in the checkpoint, 0.9 here"),
        ({"evaluation": Evaluation(5, 1)}, r"evaluation: None in the checkpoint, \[5, 1\] here"),
        ({"tf32": True}, "tf32: False in the checkpoint, True here"),
    ],
)
def test_a_state_of_other_arguments_is_refused(change, message):
    state = make("SAC", "Pendulum-CA").state()
    with pytest.raises(CheckpointError, match=message):
        make("SAC", "Pendulum-CA", **change).restore(state)


def test_a_state_of_other_names_seeds_or_engine_is_refused():
    state = make("SAC", "Pendulum-CA").state()
    with pytest.raises(CheckpointError, match="environment: "):
        make("SAC", "Acrobot-CA").restore(state)
    with pytest.raises(CheckpointError, match="seeds: "):
        Run("SAC", "Pendulum-CA", population("SAC"), [3, 1, 5], steps=STEPS, cutoff=CUTOFF).restore(state)
    with kernels.using("torch"):
        other = make("SAC", "Pendulum-CA")
    if kernels.library("cpu") is not None:
        with pytest.raises(CheckpointError, match="engine: native in the checkpoint, torch here"):
            other.restore(state)


@pytest.mark.parametrize(
    "lost", ["structure", "lockstep.replay['rows']", "lockstep.agents.critic.online.parameters", "arguments"]
)
def test_a_state_that_is_not_whole_is_refused(lost):
    state = make("SAC", "Pendulum-CA").state()
    del state[lost]
    with pytest.raises(CheckpointError):
        make("SAC", "Pendulum-CA").restore(state)


def test_a_run_takes_as_many_steps_as_it_has_and_finishes_then():
    run = make("SAC", "Pendulum-CA")
    run.advance(STEPS - 1)
    with pytest.raises(ValueError, match="89 steps of 90 are taken"):
        run.finish()
    with pytest.raises(ValueError, match="2 steps from step 89 on: there are 90 in all"):
        run.advance(2)
    run.advance()
    assert run.step == run.steps == STEPS
    assert run.finish().steps == STEPS


class Looking:
    """Learns nothing, and notes how numbers are computed."""

    hypers, actions, seen = ActorCriticHypers, ("continuous",), []

    def __init__(self, population, task, stream):
        self.size = len(population)

    def act(self, observations, step):
        self.seen.append(conditions())
        return torch.zeros(self.size, 1)

    def update(self, batch, step):
        return torch.zeros(self.size)


def conditions():
    """Whether denormal numbers are zero, gradients are recorded, and products may be rounded."""
    return bool(torch.tensor(1e-40) * 1 == 0), torch.is_grad_enabled(), torch.backends.cuda.matmul.allow_tf32


@pytest.mark.parametrize("tf32", [True, False])
def test_numbers_are_computed_alike_whatever_the_caller_does_and_the_caller_is_not_disturbed(tf32):
    seen = find_algorithm(f"{__name__}:Looking").load().seen
    seen.clear()
    torch.backends.cuda.matmul.allow_tf32 = not tf32
    try:
        run = make(f"{__name__}:Looking", "Pendulum-CA", tf32=tf32)
        run.advance(2)
        between = conditions()
        run.advance(1)
    finally:
        torch.backends.cuda.matmul.allow_tf32 = False
    assert seen == [(True, False, tf32)] * 3
    assert between == (False, True, not tf32)


class Counting:
    """Learns nothing, but its actions depend on all that it keeps, in every form that it keeps it."""

    hypers, actions = ActorCriticHypers, ("continuous",)

    def __init__(self, population, task, stream):
        self.population, self.stream, self.size = population, stream, len(population)
        self.counter, self.factors = 0, {"a": 1.0, 3: [torch.zeros(self.size)]}
        self.history, self.previous, self.array = [], None, np.zeros((2, self.size))
        self.current = torch.zeros(self.size, task.observation_size)
        self.generator = np.random.default_rng(5)

    def act(self, observations, step):
        self.counter += 1
        self.factors["a"] *= 0.99
        self.factors[3][0] += observations[:, 0]
        self.previous, self.current = self.current, observations
        self.history = [*self.history[-2:], observations[:, 1].clone()]
        self.array[self.counter % 2] += self.generator.random()
        total = torch.stack(self.history).sum(0) + self.factors[3][0] * self.factors["a"] + self.previous.sum(1)
        total += torch.from_numpy(self.array).sum(0).float() + self.counter
        return total.sin().unsqueeze(1)

    def update(self, batch, step):
        return torch.zeros(self.size)


class WithRandomness(Counting):
    """Keeps what cannot be saved."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.tools = {"dice": random.Random(1)}


class WithItsOwnWay(WithRandomness):
    """Says itself what is to be saved."""

    def act(self, observations, step):
        return super().act(observations, step) + self.tools["dice"].random()

    def state_for_checkpoint(self):
        version, numbers, following = self.tools["dice"].getstate()
        kept = {name: getattr(self, name) for name in ("counter", "factors", "history", "previous", "array", "current")}
        return {"dice": [version, np.array(numbers), following], "generator": self.generator.bit_generator.state, **kept}

    def restore_from_checkpoint(self, state):
        version, numbers, following = state.pop("dice")
        self.tools["dice"].setstate((version, tuple(numbers.tolist()), following))
        self.generator.bit_generator.state = state.pop("generator")
        for name, value in state.items():
            setattr(self, name, np.array(value) if isinstance(value, np.ndarray) else value)


class WithACache(WithRandomness):
    """Names what need not be saved."""

    not_in_checkpoints = ("tools",)


def test_an_algorithm_of_ones_own_resumes_whatever_it_keeps():
    check_resumed(f"{__name__}:Counting", "MountainCar-CA")
    check_resumed(f"{__name__}:WithItsOwnWay", "MountainCar-CA", places=(1, 47))
    check_resumed(f"{__name__}:WithACache", "MountainCar-CA", places=(47,))


def test_what_cannot_be_saved_is_named():
    run = make(f"{__name__}:WithRandomness", "MountainCar-CA")
    with pytest.raises(CheckpointError, match=r"^lockstep\.agents\.tools\['dice'\]: a random\.Random cannot be saved"):
        run.state()


def test_a_gymnasium_environment_is_brought_back_by_its_own_actions():
    """An untrained agent's pole falls after some ten steps, at other times for each copy."""
    uninterrupted = check_resumed("SAC", "CartPole-v1", cutoff=30, places=(1, 10, 24, 47, 70, 89))
    ends = [set(uninterrupted.finish().first_step[uninterrupted.finish().agent == agent]) for agent in range(3)]
    assert len(ends[0]) > 3 and ends[0] != ends[1] != ends[2]


@pytest.mark.mujoco
def test_so_is_one_with_an_inner_state_that_observations_do_not_show():
    check_resumed("SAC", "HalfCheetah-v5", cutoff=35, places=(1, 34, 35, 36, 47))


def test_only_the_actions_of_the_present_episodes_are_kept():
    world, stream = GymnasiumEnvironment("counting/Terminates-v0", 2), RandomStream(torch.tensor([0, 1]))
    world.start(stream, 0)
    for step in range(1, 101):
        ended = world.step(torch.zeros(2, 3), torch.zeros(2, 1)).terminated
        if ended.any():
            world.start(stream, step, ended)
        if step == 2:
            world.start(stream, step, torch.tensor([True, False]))
        assert len(world._given_since) <= 8
    state = world.state_for_checkpoint()
    assert state["lengths"].tolist() == [2, 0] and len(state["actions"]) == 2


class Forgetful(counting_environments.Counting):
    """Its episodes are not what seed and actions make of them."""

    count = 0

    def step(self, action):
        Forgetful.count += 1
        observation, *rest = super().step(action)
        observation[1] = Forgetful.count
        return observation, *rest


gymnasium.register("counting/Forgetful-v0", entry_point=Forgetful, kwargs={"action_space": spaces.Box(-1, 1, (1,))})


def test_an_environment_that_does_not_repeat_itself_is_not_gone_on_with():
    run = make("SAC", "counting/Forgetful-v0")
    run.advance(10)
    with pytest.raises(
        CheckpointError, match=r"does not repeat its own episode, given its seed and actions \(copies \[0, 1, 2\]\)"
    ):
        make("SAC", "counting/Forgetful-v0").restore(copied(run.state()))


class GraphOnTheHost:
    """Stands in for a CUDA graph. Recording has taken the step already, so that the first replay has nothing to do."""

    def __init__(self):
        self.recorded, self.replays = RecordedGraph(), 0

    def replay(self):
        if self.replays:
            self.recorded.replay()
        self.replays += 1


@pytest.fixture
def captured(monkeypatch):
    """Make runs whose steps are captured and replayed as on a GPU."""
    stream = types.SimpleNamespace(wait_stream=lambda other: None)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: stream)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: contextlib.nullcontext())
    monkeypatch.setattr(torch.cuda, "CUDAGraph", GraphOnTheHost)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph, stream: graph.recorded)

    def make_captured(*arguments, **keywords):
        run = make(*arguments, **keywords)
        run._lockstep._captured, run._lockstep._side = True, stream
        return run

    with kernels.using("torch"):
        yield make_captured


@pytest.mark.parametrize(("algorithm", "environment"), PAIRS)
def test_a_resumed_population_is_captured_anew_and_equals_one_that_took_its_steps_one_by_one(algorithm, environment, captured):
    uninterrupted, interrupted = make(algorithm, environment), captured(algorithm, environment)
    uninterrupted.advance(STEPS)
    for place, state in saved_at(interrupted, (10, 50)).items():
        resumed = captured(algorithm, environment)
        resumed.restore(state)
        resumed.advance(STEPS - place)
        assert resumed._lockstep._graph.replays > 30
        assert_same(uninterrupted, resumed)
    assert_same(uninterrupted, interrupted)


@pytest.mark.gpu
@pytest.mark.parametrize(("algorithm", "environment"), PAIRS)
def test_a_population_resumes_on_a_gpu(algorithm, environment):
    check_resumed(algorithm, environment, places=(10, BATCH, 47), device="cuda")
