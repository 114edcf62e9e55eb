"""The populations' updates against plain single agents with autograd and torch.optim.Adam."""

import plain_agents
import pytest
import torch

from agents.algorithm import Task
from agents.population import Population
from agents.registry import ALGORITHMS
from agents.replay import Batch
from agents.rng import Purpose
from agents.spaces import Continuous, Discrete

P, B, S = 3, 8, 4
STEP_SIZES, SCALES, POLYAKS = (1e-2, 1e-3, 3e-4), (0.1, 1.0, 2.0), (0.01, 0.5, 0.1)
# Not 1: where all elites and the action of the "score" estimate are clamped, gradients cancel to 0 or 1e-9, and Adam makes a
# whole step of it.
ENTROPY_SCALES = (0.01, 0.7, 10.0)
CONTINUOUS, CONTINUOUS_2, DISCRETE = Continuous((-1.0,), (2.0,)), Continuous((-1.0, -3.0), (2.0, 1.0)), Discrete(3)

PLAIN = {
    "GreedyAC": plain_agents.PlainGreedyAC,
    "VanillaAC": plain_agents.PlainVanillaAC,
    "SAC": plain_agents.PlainSAC,
    "SAC-original": plain_agents.PlainSACOriginal,
    "DDPG": plain_agents.PlainDDPG,
}
THREE = {"hidden_layers": (64, 64, 64)}
CASES = [
    *[("GreedyAC", CONTINUOUS, {"entropy_gradient": name}) for name in ("sampled", "analytic", "score")],
    ("GreedyAC", CONTINUOUS, THREE),
    ("GreedyAC", CONTINUOUS_2, {"hidden_layers": (32,)}),
    ("GreedyAC", CONTINUOUS, {"elite_reduction": "sum", "num_action_samples": 20, "elite_fraction": 0.25}),
    *[("VanillaAC", CONTINUOUS, {"entropy_gradient": name}) for name in ("sampled", "analytic", "score")],
    ("VanillaAC", CONTINUOUS_2, THREE),
    ("SAC", CONTINUOUS, {}),
    ("SAC", CONTINUOUS_2, THREE),
    ("SAC", CONTINUOUS, {"entropy_tuning": "automatic"}),
    ("SAC", DISCRETE, {"entropy_tuning": "automatic"}),
    ("SAC-original", CONTINUOUS, {}),
    ("SAC-original", CONTINUOUS_2, THREE),
    ("DDPG", CONTINUOUS, {}),
    ("DDPG", CONTINUOUS_2, THREE),
    *[
        (name, DISCRETE, {"discrete_critic_input": kind})
        for name in ("GreedyAC", "VanillaAC", "SAC", "SAC-original")
        for kind in ("index", "one-hot")
    ],
]


def stacked_hypers(algorithm, shared):
    cls = ALGORITHMS[algorithm].hypers
    own = {
        "critic_step_size": STEP_SIZES,
        "actor_step_size_scale": SCALES,
        "entropy_scale": ENTROPY_SCALES,
        "polyak": POLYAKS,
        "state_value_step_size": STEP_SIZES[::-1],
        "exploration_scale": (0.0, 0.1, 0.3),
    }
    return tuple(cls(batch_size=B, **shared, **{k: v[p] for k, v in own.items() if k in cls.table}) for p in range(P))


def random_batch(generator, space):
    states = torch.randn(P, B, S, generator=generator)
    if isinstance(space, Discrete):
        actions = torch.randint(space.count, (P, B, 1), generator=generator).float()
    else:
        actions = torch.rand(P, B, space.size, generator=generator) * 2 - 1
    return Batch(
        states=states,
        actions=actions,
        states_actions=torch.cat([states, actions], -1),
        rewards=torch.randn(P, B, 1, generator=generator),
        continues=(torch.rand(P, B, 1, generator=generator) > 0.3).float(),
        next_states=torch.randn(P, B, S, generator=generator),
    )


def population_networks(agents):
    """Names as the plain agents have them → the population's networks."""
    found = {"critics": agents.critic.online, "targets": getattr(agents.critic, "target", None)}
    for name, attribute in (("actor", "actor"), ("proposal", "proposal"), ("value", "value"), ("actor_target", "actor_target")):
        network = getattr(agents, attribute, None)
        found[name] = getattr(network, "network", network)
    return found | {"value_target": getattr(agents, "target", None)}


def linears(module):
    return [layer for layer in module.modules() if isinstance(layer, torch.nn.Linear)]


def rows_of(module, network, p):
    """Pairs of a plain network and the row of the population network that is its twin."""
    modules = list(module) if isinstance(module, torch.nn.ModuleList) else [module]
    return [(each, p * len(modules) + i) for i, each in enumerate(modules)]


def copy_into(module, network, row):
    """Copy one agent's parameters from a population network into a plain one; heads lie side by side in the last layer."""
    layers = linears(module)
    hidden, heads = layers[: len(network.layers) - 1], layers[len(network.layers) - 1 :]
    weights, biases = network.layers[-1]
    sizes = [head.out_features for head in heads]
    twins = [(w[row], b[row, 0]) for w, b in network.layers[:-1]]
    twins += list(zip(weights[row].split(sizes, 1), biases[row, 0].split(sizes), strict=True))
    with torch.no_grad():
        for layer, (w, b) in zip(hidden + heads, twins, strict=True):
            layer.weight.copy_(w.T)
            layer.bias.copy_(b)


def assert_same(module, network, row):
    layers = linears(module)
    heads = layers[len(network.layers) - 1 :]
    plain = [(layer.weight.T, layer.bias) for layer in layers[: len(network.layers) - 1]]
    plain.append((torch.cat([head.weight.T for head in heads], 1), torch.cat([head.bias for head in heads])))
    for (weights, biases), (plain_weights, plain_biases) in zip(network.layers, plain, strict=True):
        distance = torch.cat([(weights[row] - plain_weights).flatten(), biases[row, 0] - plain_biases]).norm()
        assert distance <= 1e-5 * torch.cat([plain_weights.flatten(), plain_biases]).norm()


@pytest.mark.parametrize(
    ("algorithm", "space", "shared"), CASES, ids=[f"{a}-{type(s).__name__}{s.size}-{h}" for a, s, h in CASES]
)
def test_a_population_equals_plain_agents_after_five_updates(algorithm, space, shared):
    hypers = stacked_hypers(algorithm, shared)
    population = Population(hypers, (3, 1, 4), torch.device("cpu"))
    stream = population.stream()
    agents = ALGORITHMS[algorithm].load()(population, Task(S, space, 0.99), stream)
    discrete = isinstance(space, Discrete)
    bounds = (None, space.count) if discrete else (torch.tensor(space.low), torch.tensor(space.high))
    plain = [PLAIN[algorithm](h, S, *bounds) for h in hypers]
    networks = population_networks(agents)
    for p, agent in enumerate(plain):
        for name, module in agent.networks().items():
            for twin, row in rows_of(module, networks[name], p):
                copy_into(twin, networks[name], row)
    generator = torch.Generator().manual_seed(0)
    samples = (hypers[0].num_action_samples,) if hasattr(hypers[0], "num_action_samples") else ()
    for step in range(1, 6):
        batch = random_batch(generator, space)
        with torch.no_grad():
            losses = agents.update(batch, step)
        for p, agent in enumerate(plain):
            policy_shape = (B, *samples, space.size)
            draw = stream.uniforms if discrete else stream.normals
            noise = {
                "next": draw(Purpose.NEXT_ACTION, step, B * space.size)[p].view(B, space.size),
                "policy": stream.normals(Purpose.POLICY_UPDATE, step, torch.Size(policy_shape).numel())[p].view(policy_shape),
            }
            own = [getattr(batch, name)[p] for name in ("states", "actions", "rewards", "continues", "next_states")]
            assert losses[p].item() == pytest.approx(agent.update(*own, noise, 0.99), rel=1e-4)
    for p, agent in enumerate(plain):
        for name, module in agent.networks().items():
            for twin, row in rows_of(module, networks[name], p):
                assert_same(twin, networks[name], row)
    if shared.get("entropy_tuning") == "automatic":
        learned = torch.tensor([agent.entropy_scale for agent in plain])
        torch.testing.assert_close(agents.entropy_scale.flatten(), learned, rtol=1e-5, atol=0)
        assert not torch.equal(learned, torch.tensor(ENTROPY_SCALES))


def test_every_registered_algorithm_has_a_plain_twin_and_is_tested_in_every_action_space_it_can_act_in():
    assert PLAIN.keys() == ALGORITHMS.keys()
    tested = {(name, "discrete" if isinstance(space, Discrete) else "continuous") for name, space, _ in CASES}
    assert tested == {(name, kind) for name, algorithm in ALGORITHMS.items() for kind in algorithm.actions}


def test_networks_that_must_start_equal_or_different_do():
    def made(algorithm):
        population = Population(stacked_hypers(algorithm, {}), (0, 1, 2), torch.device("cpu"))
        return ALGORITHMS[algorithm].load()(population, Task(S, CONTINUOUS, 0.99), population.stream())

    critics = made("SAC").critic.online.parameters
    assert not torch.equal(critics[0], critics[1])
    greedy = made("GreedyAC")
    assert torch.equal(greedy.actor.network.parameters, greedy.proposal.network.parameters)
    assert torch.equal(greedy.critic.online.parameters, greedy.critic.target.parameters)


@pytest.mark.parametrize("exploration", ["gaussian", "ornstein-uhlenbeck"])
def test_ddpg_explores_with_the_process_that_is_asked_for(exploration):
    population = Population(stacked_hypers("DDPG", {"exploration_noise": exploration}), (0, 1, 2), torch.device("cpu"))
    stream = population.stream()
    with torch.no_grad():
        agents = ALGORITHMS["DDPG"].load()(population, Task(S, CONTINUOUS_2, 0.99), stream)
        agents.actor.parameters.zero_()  # π(S) is the middle of the range
        middle, half = torch.tensor([0.5, -1.0]), torch.tensor([1.5, 2.0])
        noise = torch.zeros(P, 2)
        for step in range(1, 50):
            drawn = torch.tensor([0.0, 0.1, 0.3])[:, None] * stream.normals(Purpose.ACTION, step, 2)
            noise = drawn if exploration == "gaussian" else 0.85 * noise + drawn
            expected = torch.clamp(middle + half * noise, torch.tensor(CONTINUOUS_2.low), torch.tensor(CONTINUOUS_2.high))
            torch.testing.assert_close(agents.act(torch.zeros(P, S), step), expected)
