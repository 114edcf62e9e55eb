import pytest
import torch

from agents import kernels
from agents.replay import Replay
from agents.rng import RandomStream


def filled(population, capacity, num_added):
    """Transition t of agent p: state (p, t), action 10t, reward t, successor (p, t + 1), terminated when t is a multiple of 3."""
    replay = Replay(population, capacity, 2, 1, torch.device("cpu"))
    agents = torch.arange(population, dtype=torch.float32)
    for t in range(num_added):
        time = torch.full((population,), float(t))
        replay.add(
            torch.stack([agents, time], 1),
            time[:, None] * 10,
            time,
            torch.full((population,), t % 3 == 0),
            torch.stack([agents, time + 1], 1),
        )
    return replay


def test_sampled_transitions_are_whole_and_stay_with_their_agent():
    stream = RandomStream(torch.arange(3))
    batch = filled(3, 100, 50).sample(stream, 50, 200)
    time = batch.states[..., 1]
    assert torch.equal(batch.states[..., 0], torch.arange(3.0)[:, None].expand(3, 200))
    assert torch.equal(batch.actions[..., 0], 10 * time)
    assert torch.equal(batch.rewards[..., 0], time)
    assert torch.equal(batch.continues[..., 0], (time % 3 != 0).float())
    assert torch.equal(batch.next_states[..., 1], time + 1)
    assert torch.equal(batch.states_actions, torch.cat([batch.states, batch.actions], -1))
    assert set(time.unique().tolist()) <= set(range(50)) and len(time.unique()) == 50


def test_agents_with_different_seeds_draw_different_minibatches():
    times = filled(2, 100, 100).sample(RandomStream(torch.tensor([0, 1])), 100, 32).rewards
    assert not torch.equal(times[0], times[1])


def test_a_full_buffer_forgets_the_oldest():
    batch = filled(1, 10, 25).sample(RandomStream(torch.tensor([0])), 25, 500)
    assert set(batch.rewards.flatten().unique().tolist()) == set(range(15, 25))


@pytest.mark.skipif(kernels.report().engine == "torch", reason="no native kernels here")
def test_both_engines_take_the_same_rows_from_buffers_of_any_width():
    for state_size, action_size in ((1, 1), (3, 2), (17, 6), (40, 1)):
        batches = []
        for engine in ("auto", "torch"):
            with kernels.using(engine):
                replay = Replay(3, 500, state_size, action_size, torch.device("cpu"))
                replay.rows.copy_(torch.arange(replay.rows.numel()).view(replay.rows.shape))
                replay.num_added = 500
                batches.append(replay.sample(RandomStream(torch.arange(3)), 7, 41))
        for name in ("states", "actions", "states_actions", "rewards", "continues", "next_states"):
            assert torch.equal(getattr(batches[0], name), getattr(batches[1], name)), name


def test_a_stream_of_other_agents_is_refused():
    with pytest.raises(ValueError, match="a stream of 4 agents for the buffers of 3"):
        filled(3, 10, 10).sample(RandomStream(torch.arange(4)), 10, 2)
