"""Single agents written the obvious way, with torch.nn, autograd and torch.optim.Adam.

The oracle of the population's algorithms, and the baseline of the speed benchmark. They share no code with `agents`. Each has
`networks()`, name → module, and `update(states, actions, rewards, continues, next_states, noise, discount)` with batches [B, …];
`noise` has "next" and "policy": standard normal numbers, or uniform ones ("next", discrete actions).
"""

import copy
import math

import torch
from torch import nn


def multilayer_perceptron(inputs, hidden, outputs):
    """Return a ReLU network with Xavier-uniform weights (gain √2) and zero biases; without outputs, its trunk."""
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


class GaussianActor(nn.Module):
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


class PlainAgent:
    """What they have in common: a critic (or two) with targets, an actor, and how to descend.

    `low` and `high` are the bounds of continuous actions; with discrete ones `low` is None and `high` their number.
    """

    num_critics = 1

    def __init__(self, hypers, states, low, high):
        self.hypers, self.low, self.high, self.discrete = hypers, low, high, low is None
        self.one_hot = self.discrete and hypers.discrete_critic_input == "one-hot"
        width = states + (high if self.one_hot else 1 if self.discrete else len(low))
        self.critics = nn.ModuleList(multilayer_perceptron(width, hypers.hidden_layers, 1) for _ in range(self.num_critics))
        self.targets = copy.deepcopy(self.critics)
        self.actor = self.make_actor(states)
        self.make_more(states)
        self.actor_step_size = hypers.actor_step_size_scale * hypers.critic_step_size
        self.critic_optimizer = torch.optim.Adam(self.critics.parameters(), lr=hypers.critic_step_size)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=self.actor_step_size)

    def make_actor(self, states):
        if self.discrete:
            return multilayer_perceptron(states, self.hypers.hidden_layers, self.high)
        return GaussianActor(states, len(self.low), self.hypers.hidden_layers)

    def make_more(self, states):
        pass

    def networks(self):
        return {"critics": self.critics, "targets": self.targets, "actor": self.actor}

    def q(self, critics, states, actions):
        """The smallest value among critics."""
        if self.one_hot:
            actions = torch.eye(self.high)[actions.squeeze(-1).long()]
        return torch.stack([critic(torch.cat([states, actions], -1)) for critic in critics]).min(0).values

    def q_of_all(self, critics, states):
        every = [self.q(critics, states, torch.full((len(states), 1), float(a))) for a in range(self.high)]
        return torch.cat(every, -1)

    def learn_critics(self, states, actions, targets):
        inputs = torch.eye(self.high)[actions.squeeze(-1).long()] if self.one_hot else actions
        pairs = torch.cat([states, inputs], -1)
        loss = sum(nn.functional.mse_loss(critic(pairs), targets.detach()) for critic in self.critics)
        self.descend(self.critic_optimizer, loss)
        return loss.item()

    def average(self, target, online):
        with torch.no_grad():
            for old, new in zip(target.parameters(), online.parameters(), strict=True):
                old.copy_((1 - self.hypers.polyak) * old + self.hypers.polyak * new)

    @staticmethod
    def descend(optimizer, loss):
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    def choose(self, probabilities, uniform):
        """The first action at which the cumulated probability passes the uniform number."""
        passed = probabilities.cumsum(-1) > uniform
        return torch.where(passed.any(-1, keepdim=True), passed.float().argmax(-1, keepdim=True), self.high - 1).float()

    def categorical(self, states):
        return torch.distributions.Categorical(logits=self.actor(states))


class ClampedGaussianAgent(PlainAgent):
    """What GreedyAC and VanillaAC have in common."""

    def distribution(self, network, states):
        raw, log_std = network(states)
        mean = self.low + (torch.tanh(raw) + 1) / 2 * (self.high - self.low)
        return torch.distributions.Independent(torch.distributions.Normal(mean, log_std.exp()), 1)

    def sample(self, network, states, noise):
        normal = self.distribution(network, states).base_dist
        return torch.clamp(normal.mean + normal.stddev * noise, self.low, self.high).detach()

    def act(self, state, noise):
        return self.sample(self.actor, state, noise)

    def sarsa(self, states, actions, rewards, continues, next_states, noise, discount):
        with torch.no_grad():
            if self.discrete:
                next_actions = self.choose(self.categorical(next_states).probs, noise["next"])
            else:
                next_actions = self.sample(self.actor, next_states, noise["next"])
            targets = rewards + discount * continues * self.q(self.targets, next_states, next_actions)
        loss = self.learn_critics(states, actions, targets)
        self.average(self.targets, self.critics)
        return loss

    def entropy(self, network, states, noise):
        """A quantity whose gradient is the estimate of the entropy's gradient."""
        distribution = self.distribution(network, states)
        if self.hypers.entropy_gradient == "analytic":
            return distribution.entropy().mean()
        normal = distribution.base_dist
        action = (normal.mean + normal.stddev * noise).detach()
        if self.hypers.entropy_gradient == "score":
            return -distribution.log_prob(torch.clamp(action, self.low, self.high)).mean()
        log_prob = distribution.log_prob(action)
        return -(log_prob.detach() * log_prob).mean()


class PlainGreedyAC(ClampedGaussianAgent):
    """One GreedyAC agent."""

    def make_more(self, states):
        if not self.discrete:
            self.proposal = copy.deepcopy(self.actor)
            step_size = self.hypers.actor_step_size_scale * self.hypers.critic_step_size
            self.proposal_optimizer = torch.optim.Adam(self.proposal.parameters(), lr=step_size)

    def networks(self):
        return super().networks() | ({} if self.discrete else {"proposal": self.proposal})

    def update(self, states, actions, rewards, continues, next_states, noise, discount):
        loss = self.sarsa(states, actions, rewards, continues, next_states, noise, discount)
        if self.discrete:
            best = self.q_of_all(self.critics, states).argmax(-1)
            self.descend(self.actor_optimizer, -self.categorical(states).log_prob(best).mean())
            return loss
        B, N = len(states), self.hypers.num_action_samples
        repeated = states.unsqueeze(1).expand(B, N, states.shape[1])
        samples = self.sample(self.proposal, repeated, noise["policy"])
        with torch.no_grad():
            values = self.q(self.critics, repeated, samples).squeeze(-1)
        order = values.argsort(dim=1, descending=True)[:, : round(self.hypers.elite_fraction * N)]
        elites = torch.stack([samples[b, order[b]] for b in range(B)])
        of_elites = states.unsqueeze(1).expand(B, elites.shape[1], states.shape[1])
        times = 1 if self.hypers.elite_reduction == "mean" else elites.shape[1]
        self.descend(self.actor_optimizer, -times * self.distribution(self.actor, of_elites).log_prob(elites).mean())
        log_likelihood = times * self.distribution(self.proposal, of_elites).log_prob(elites).mean()
        entropy = self.entropy(self.proposal, states, noise["policy"][:, 0])
        self.descend(self.proposal_optimizer, -(log_likelihood + self.hypers.entropy_scale * entropy))
        return loss


class PlainVanillaAC(ClampedGaussianAgent):
    """One VanillaAC agent."""

    def update(self, states, actions, rewards, continues, next_states, noise, discount):
        loss = self.sarsa(states, actions, rewards, continues, next_states, noise, discount)
        if self.discrete:
            policy = self.categorical(states)
            bracket = self.q_of_all(self.critics, states) - self.hypers.entropy_scale * policy.logits
            self.descend(self.actor_optimizer, -(policy.probs * bracket.detach()).sum(-1).mean())
            return loss
        B, N = len(states), self.hypers.num_action_samples
        repeated = states.unsqueeze(1).expand(B, N, states.shape[1])
        samples = self.sample(self.actor, repeated, noise["policy"])
        with torch.no_grad():
            values = self.q(self.critics, repeated, samples).squeeze(-1)
        advantage = values[:, 0] - values[:, 1 : N - 1].mean(1)
        log_prob = self.distribution(self.actor, states).log_prob(samples[:, 0])
        entropy = self.entropy(self.actor, states, noise["policy"][:, N - 1])
        self.descend(self.actor_optimizer, -((log_prob * advantage).mean() + self.hypers.entropy_scale * entropy))
        return loss


class SoftAgent(PlainAgent):
    """What SAC and SAC-original have in common."""

    num_critics = 2

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

    @property
    def entropy_scale(self):
        return self.hypers.entropy_scale

    def learn_actor(self, states, noise):
        """Descend, and return ln π of the policy before."""
        if self.discrete:
            policy = self.categorical(states)
            bracket = self.q_of_all(self.critics, states) - self.entropy_scale * policy.logits
            log_prob = (policy.probs * policy.logits).sum(-1).detach()
            self.descend(self.actor_optimizer, -(policy.probs * bracket.detach()).sum(-1).mean())
            return log_prob
        new_actions, log_prob = self.sample(states, noise["policy"])
        values = self.q(self.critics, states, new_actions)
        self.descend(self.actor_optimizer, (self.entropy_scale * log_prob - values).mean())
        return log_prob.detach()


class PlainSAC(SoftAgent):
    """One SAC agent with two critics."""

    def make_more(self, states):
        self.log_scale = torch.tensor(math.log(self.hypers.entropy_scale), requires_grad=True)
        self.scale_optimizer = torch.optim.Adam([self.log_scale], lr=self.hypers.critic_step_size)

    @property
    def entropy_scale(self):
        return self.log_scale.exp().item() if self.hypers.entropy_tuning == "automatic" else self.hypers.entropy_scale

    def update(self, states, actions, rewards, continues, next_states, noise, discount):
        with torch.no_grad():
            if self.discrete:
                policy = self.categorical(next_states)
                next_actions = self.choose(policy.probs, noise["next"])
                next_log_prob = policy.log_prob(next_actions.squeeze(-1)).unsqueeze(-1)
            else:
                next_actions, next_log_prob = self.sample(next_states, noise["next"])
            soft = self.q(self.targets, next_states, next_actions) - self.entropy_scale * next_log_prob
            targets = rewards + discount * continues * soft
        loss = self.learn_critics(states, actions, targets)
        self.average(self.targets, self.critics)
        log_prob = self.learn_actor(states, noise)
        if self.hypers.entropy_tuning == "automatic":
            target = 0.98 * math.log(self.high) if self.discrete else -len(self.low)
            self.descend(self.scale_optimizer, (self.log_scale * (-log_prob - target)).mean())
        return loss


class PlainSACOriginal(SoftAgent):
    """One SAC-original agent: two critics, a state-value network and its target."""

    def make_more(self, states):
        self.value = multilayer_perceptron(states, self.hypers.hidden_layers, 1)
        self.value_target = copy.deepcopy(self.value)
        self.value_optimizer = torch.optim.Adam(self.value.parameters(), lr=self.hypers.state_value_step_size)

    def networks(self):
        return {"critics": self.critics, "actor": self.actor, "value": self.value, "value_target": self.value_target}

    def update(self, states, actions, rewards, continues, next_states, noise, discount):
        with torch.no_grad():
            if self.discrete:
                policy = self.categorical(states)
                soft = (policy.probs * (self.q_of_all(self.critics, states) - self.entropy_scale * policy.logits)).sum(
                    -1, keepdim=True
                )
            else:
                now, log_prob = self.sample(states, noise["next"])
                soft = self.q(self.critics, states, now) - self.entropy_scale * log_prob
        self.descend(self.value_optimizer, nn.functional.mse_loss(self.value(states), soft))
        loss = self.learn_critics(states, actions, rewards + discount * continues * self.value_target(next_states))
        self.average(self.value_target, self.value)
        self.learn_actor(states, noise)
        return loss


class PlainDDPG(PlainAgent):
    """One DDPG agent."""

    def make_actor(self, states):
        return multilayer_perceptron(states, self.hypers.hidden_layers, len(self.low))

    def make_more(self, states):
        self.actor_target = copy.deepcopy(self.actor)

    def networks(self):
        return super().networks() | {"actor_target": self.actor_target}

    def policy(self, actor, states):
        return (self.high - self.low) / 2 * torch.tanh(actor(states)) + (self.high + self.low) / 2

    def act(self, state, noise):
        noisy = self.policy(self.actor, state) + self.hypers.exploration_scale * (self.high - self.low) / 2 * noise
        return torch.clamp(noisy, self.low, self.high).detach()

    def update(self, states, actions, rewards, continues, next_states, noise, discount):
        next_values = self.q(self.targets, next_states, self.policy(self.actor_target, next_states))
        loss = self.learn_critics(states, actions, rewards + discount * continues * next_values)
        self.descend(self.actor_optimizer, -self.q(self.critics, states, self.policy(self.actor, states)).mean())
        self.average(self.targets, self.critics)
        self.average(self.actor_target, self.actor)
        return loss
