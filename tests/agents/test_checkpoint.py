"""A population that was saved and restored goes on as if it had never stopped, bit for bit."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from resumed_runs import BATCH, CUTOFF, PAIRS, SMALL, STEPS, check_resumed, copied, make, networks_of, population

from agents import kernels, records
from agents.checkpoint import CheckpointError
from agents.evaluation import Evaluation
from agents.hypers import ActorCriticHypers
from agents.registry import find_algorithm
from agents.training import Run


@pytest.fixture(params=["auto", "torch"])
def engine(request):
    """The engine that this machine trains with, and the one in pure torch."""
    with kernels.using(request.param):
        yield


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
