"""Single agents written the obvious way, with torch.nn, autograd and torch.optim.Adam.

The oracle of the population's algorithms, and the baseline of the speed benchmark. They share no code with `agents`.
"""

import copy
import math

import torch
from torch import nn


def multilayer_perceptron(inputs, hidden, outputs):
    """Return a ReLU network with Xavier-uniform weights (gain √2) and zero biases."""
    layers, width = [], inputs
    for size in hidden:
        layers += [nn.Linear(width, size), nn.ReLU()]
        width = size
    if outputs is not None:
        layers.append(nn.Linear(width, outputs))
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight, gain=math.sqrt(2))
            nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)


class Actor(nn.Module):
    """A trunk with a head for the mean and a head for ln σ."""

    def __init__(self, states, actions, hidden):
        super().__init__()
        self.trunk = multilayer_perceptron(states, hidden, None)
        self.mean = multilayer_perceptron(hidden[-1], (), actions)[0]
        self.log_std = multilayer_perceptron(hidden[-1], (), actions)[0]

    def forward(self, states):
        features = self.trunk(states)
        limit = math.log(1000)
        return self.mean(features), torch.clamp(self.log_std(features), -limit, limit)


class PlainGreedyAC:
    """One GreedyAC agent."""

    def __init__(self, hypers, states, low, high):
        self.hypers, self.low, self.high = hypers, low, high
        self.critic = multilayer_perceptron(states + len(low), hypers.hidden_layers, 1)
        self.target = copy.deepcopy(self.critic)
        self.actor = Actor(states, len(low), hypers.hidden_layers)
        self.proposal = copy.deepcopy(self.actor)
        self.start_optimizers()

    def start_optimizers(self):
        actor_step_size = self.hypers.actor_step_size_scale * self.hypers.critic_step_size
        self.critic_optimizer = torch.optim.Adam(self.critic.parameters(), lr=self.hypers.critic_step_size)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=actor_step_size)
        self.proposal_optimizer = torch.optim.Adam(self.proposal.parameters(), lr=actor_step_size)

    def distribution(self, network, states):
        raw, log_std = network(states)
        mean = self.low + (torch.tanh(raw) + 1) / 2 * (self.high - self.low)
        return torch.distributions.Independent(torch.distributions.Normal(mean, log_std.exp()), 1)

    def sample(self, network, states, noise):
        normal = self.distribution(network, states).base_dist
        return torch.clamp(normal.mean + normal.stddev * noise, self.low, self.high).detach()

    def act(self, state, noise):
        return self.sample(self.actor, state, noise)

    def update(self, states, actions, rewards, continues, next_states, noise, discount):
        """`noise` has "next" [B, A] and "policy" [B, N, A]."""
        hypers, B, N = self.hypers, len(states), self.hypers.num_action_samples
        next_actions = self.sample(self.actor, next_states, noise["next"])
        with torch.no_grad():
            next_values = self.target(torch.cat([next_states, next_actions], -1))
            targets = rewards + discount * continues * next_values
        loss = nn.functional.mse_loss(self.critic(torch.cat([states, actions], -1)), targets)
        self.descend(self.critic_optimizer, loss)
        self.average(self.target, self.critic)

        repeated = states.unsqueeze(1).expand(B, N, states.shape[1])
        samples = self.sample(self.proposal, repeated, noise["policy"])
        with torch.no_grad():
            values = self.critic(torch.cat([repeated, samples], -1)).squeeze(-1)
        order = values.argsort(dim=1, descending=True)[:, : round(hypers.elite_fraction * N)]
        elites = torch.stack([samples[b, order[b]] for b in range(B)])
        of_elites = states.unsqueeze(1).expand(B, elites.shape[1], states.shape[1])

        self.descend(self.actor_optimizer, -self.distribution(self.actor, of_elites).log_prob(elites).mean())
        log_likelihood = self.distribution(self.proposal, of_elites).log_prob(elites).mean()
        entropy = self.entropy(states, noise["policy"][:, 0])
        self.descend(self.proposal_optimizer, -(log_likelihood + hypers.entropy_scale * entropy))
        return loss.item()

    def entropy(self, states, noise):
        """A quantity whose gradient is the estimate of the entropy's gradient."""
        distribution = self.distribution(self.proposal, states)
        if self.hypers.entropy_gradient == "analytic":
            return distribution.entropy().mean()
        normal = distribution.base_dist
        action = (normal.mean + normal.stddev * noise).detach()
        if self.hypers.entropy_gradient == "score":
            return -distribution.log_prob(torch.clamp(action, self.low, self.high)).mean()
        log_prob = distribution.log_prob(action)
        return -(log_prob.detach() * log_prob).mean()

    def average(self, target, online):
        with torch.no_grad():
            for old, new in zip(target.parameters(), online.parameters(), strict=True):
                old.copy_((1 - self.hypers.polyak) * old + self.hypers.polyak * new)

    @staticmethod
    def descend(optimizer, loss):
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


class PlainSAC:
    """One SAC agent with two critics."""

    descend = staticmethod(PlainGreedyAC.descend)
    average = PlainGreedyAC.average

    def __init__(self, hypers, states, low, high):
        self.hypers, self.low, self.high = hypers, low, high
        self.critics = nn.ModuleList(multilayer_perceptron(states + len(low), hypers.hidden_layers, 1) for _ in range(2))
        self.targets = copy.deepcopy(self.critics)
        self.actor = Actor(states, len(low), hypers.hidden_layers)
        self.start_optimizers()

    def start_optimizers(self):
        actor_step_size = self.hypers.actor_step_size_scale * self.hypers.critic_step_size
        self.critic_optimizer = torch.optim.Adam(self.critics.parameters(), lr=self.hypers.critic_step_size)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=actor_step_size)

    def sample(self, states, noise):
        """Return reparameterized actions and their log-probability."""
        mean, log_std = self.actor(states)
        normal = torch.distributions.Normal(mean, log_std.exp())
        x = mean + log_std.exp() * noise
        scale, bias = (self.high - self.low) / 2, (self.high + self.low) / 2
        log_prob = normal.log_prob(x) - torch.log(scale * (1 - torch.tanh(x) ** 2) + 1e-6)
        return scale * torch.tanh(x) + bias, log_prob.sum(-1, keepdim=True)

    def act(self, state, noise):
        return self.sample(state, noise)[0].detach()

    def smaller(self, critics, states, actions):
        inputs = torch.cat([states, actions], -1)
        return torch.min(critics[0](inputs), critics[1](inputs))

    def update(self, states, actions, rewards, continues, next_states, noise, discount):
        """`noise` has "next" and "policy", both [B, A]."""
        with torch.no_grad():
            next_actions, next_log_prob = self.sample(next_states, noise["next"])
            next_values = self.smaller(self.targets, next_states, next_actions)
            targets = rewards + discount * continues * (next_values - self.hypers.entropy_scale * next_log_prob)
        inputs = torch.cat([states, actions], -1)
        loss = sum(nn.functional.mse_loss(critic(inputs), targets) for critic in self.critics)
        self.descend(self.critic_optimizer, loss)
        self.average(self.targets, self.critics)

        new_actions, log_prob = self.sample(states, noise["policy"])
        values = self.smaller(self.critics, states, new_actions)
        self.descend(self.actor_optimizer, (self.hypers.entropy_scale * log_prob - values).mean())
        return loss.item()
