"""Adversarial inverse reinforcement learning (AIRL) for many demonstrations at once.

``D(s, a, s') = e^f / (e^f + pi(a|s))`` with ``f = g(s) + gamma h(s') - h(s)``, so the discriminator's logit
is ``f - log pi(a|s)``. Paper: section "Preliminaries"; Fu, Luo, Levine (2018).
"""

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from dmsrd_lite.demonstrations import DemonstrationSet
from dmsrd_lite.domains import Domain, InputError
from dmsrd_lite.domains.domain import Seed, extend
from dmsrd_lite.learning.cloning import clone_behavior
from dmsrd_lite.learning.networks import (
    Actor,
    BatchedMLP,
    GaussianPolicies,
    Policies,
    one_thread,
    to_tensor,
    under,
)
from dmsrd_lite.learning.policy_optimization import PolicyOptimizer, PPOSettings
from dmsrd_lite.learning.rollouts import Rollouts, rollout

POLICY_REWARDS = ("g", "f_minus_log_pi")
Samples = tuple[
    torch.Tensor, torch.Tensor, torch.Tensor
]  # x (M, n, obs_dim), x' (M, n, obs_dim), log-density (M, n)


@dataclass(frozen=True)
class AIRLSettings:
    n_iterations: int = 30
    episodes: int = 8  # per strategy and iteration
    discount: float = 0.99  # gamma, in f and for the policy
    policy_reward: str = "g"  # "g" as in the paper, or "f_minus_log_pi" = log D - log(1 - D)
    warm_start: bool = True  # start from behavioural cloning (the paper: off)
    cloning_weight: float = (
        1.0  # weight of the demonstration's negative log-likelihood in the policy loss (the paper: 0)
    )
    cloning_steps: int = 2000
    coverage: bool = (
        True  # half of the discriminator's policy samples are of wide exploratory rollouts (the paper: off)
    )
    coverage_episodes: int = 2  # of the untrained policy and of the clone at each level
    coverage_levels: tuple[tuple[float, float], ...] = ()  # as ``Exploration.levels``; (): the domain's
    discriminator_steps: int = 12
    discriminator_batch: int = 256  # demonstration samples per strategy and step, and as many others
    discriminator_rate: float = 3e-3
    replay_iterations: int = 10  # policy samples of so many iterations are kept
    replay_samples: int = 2000  # per strategy and iteration
    reward_average: float = (
        0.9  # decay of the running average of the reward's weights; 0 keeps the last iterate
    )
    ppo: PPOSettings = PPOSettings(learning_rate=1e-4, epochs=1, sample_fraction=0.5)


class Rewards(torch.nn.Module):
    """Strategy rewards ``g_j(s)``, shaping terms ``h_j(s)`` and, where strategies share one, a task reward.

    ``R_j = g_j``, or ``R_j = R_Task + alpha g_j`` with ``alpha`` > 0 (Equation 1); each network is an MLP
    (32, 32) of the state. ``R_Task`` starts at zero. Rewards are bounded: unbounded they correlated with the
    true return as well, but none of ten fresh policies learned to balance on one frozen, with the same
    training that succeeds on a bounded one. Why is not settled.
    """

    bound = 5.0  # nats

    def __init__(self, domain: Domain, n_strategies: int, discount: float, seed: Seed, alpha: float = 0.0):
        super().__init__()
        self.domain, self.discount, self.alpha = domain, discount, alpha
        sizes = (domain.obs_dim, 32, 32, 1)
        self.strategy_reward = BatchedMLP(
            n_strategies, sizes, extend(seed, 0), last_gain=0.1 if alpha else 1.0
        )
        self.shaping = BatchedMLP(n_strategies, sizes, extend(seed, 1))
        if alpha:
            self.task_reward = BatchedMLP(1, sizes, extend(seed, 2), last_gain=0.0)

    def g(self, x: torch.Tensor) -> torch.Tensor:
        """``g_j(s) = b tanh(net_j(s) / b)``: network inputs (M, n, obs_dim) -> (M, n), within the bound b."""
        return self.bound * torch.tanh(self.strategy_reward(x)[..., 0] / self.bound)

    def task(self, x: torch.Tensor) -> torch.Tensor:
        """``R_Task(s)``, bounded as ``g`` is: (M, n, obs_dim) -> (M, n), one network for all M."""
        return self.bound * torch.tanh(
            self.task_reward(x.reshape(1, -1, x.shape[-1])).view(x.shape[:2]) / self.bound
        )

    def total(self, x: torch.Tensor) -> torch.Tensor:
        """``R_j(s) = R_Task(s) + alpha g_j(s)``, or ``g_j(s)`` where nothing is shared: (M, n)."""
        return self.task(x) + self.alpha * self.g(x) if self.alpha else self.g(x)

    def f(self, x: torch.Tensor, x_next: torch.Tensor) -> torch.Tensor:
        """``R_j(s) + gamma h_j(s') - h_j(s)``, (M, n)."""
        after, before = self.shaping(torch.cat([x_next, x], 1))[..., 0].chunk(2, 1)
        return self.total(x) + self.discount * after - before

    @one_thread()
    @torch.no_grad()
    def evaluate(self, observations: np.ndarray, part: str = "g") -> np.ndarray:
        """``g``, ``task`` or ``total`` at raw observations (..., obs_dim): (M, ...); the task (1, ...)."""
        x = to_tensor(self.domain.network_input(observations)).view(1, -1, self.domain.obs_dim)
        m = 1 if part == "task" else self.strategy_reward.n_strategies
        values = [
            getattr(self, part)(some.expand(m, -1, -1)) for some in x.split(100_000, dim=1)
        ]  # bounded memory
        return torch.cat(values, 1).numpy().reshape(m, *observations.shape[:-1])

    def mean_rewards(self, demonstrations: DemonstrationSet) -> np.ndarray:
        """``eta_S-j(tau_i)``, the mean of g_j over the states of demonstration i: (M, n)."""
        return self.evaluate(demonstrations.observations).mean((2, 3))


def discriminator_loss(demonstration_logits: torch.Tensor, sample_logits: torch.Tensor) -> torch.Tensor:
    """``-E_demo[log D] - E_samples[log(1 - D)]`` per strategy from logits (M, n): (M,) nats."""
    softplus = torch.nn.functional.softplus
    return softplus(-demonstration_logits).mean(1) + softplus(sample_logits).mean(1)


def clone_demonstrations(
    demonstrations: DemonstrationSet,
    seed: Seed,
    n_steps: int,
    streams: tuple[int, int] = (0, 1),
    progress: Callable = iter,
) -> tuple[GaussianPolicies, np.ndarray]:
    """Behavioural cloning of every demonstration: the policies and the curve of the loss
    (``clone_behavior``).

    ``streams`` of the seed: of the networks' start and of the cloning.
    """
    states, actions, _ = demonstrations.transitions()
    x = to_tensor(demonstrations.domain.network_input(states))
    policies = GaussianPolicies(demonstrations.domain, len(x), extend(seed, streams[0]))
    stream, acted = extend(seed, streams[1]), to_tensor(actions)
    curve = clone_behavior(policies, x, acted, stream, n_steps=n_steps, progress=progress)
    return policies, curve


class AIRL:
    """One batched AIRL model per demonstration; ``train`` yields a record per iteration.

    After training: ``policies`` (GaussianPolicies), ``rewards`` (the last iterate), ``averaged_rewards`` (the
    running average, to be used), ``clone`` (Actor of behavioural cloning), ``steps`` per strategy so far.
    ``networks``: those of an earlier learner (``networks()``) instead of a clone to start from. ``shared``:
    the rewards of an earlier learner, whose task reward is added to what is learned here, frozen.
    """

    alpha = 0.0  # weight of the strategy rewards beside a shared task reward; 0: no task reward
    learns_policies = True  # False: only rewards learn

    def __init__(
        self,
        demonstrations: DemonstrationSet,
        settings: AIRLSettings,
        seed: Seed,
        *,
        networks: dict[str, torch.Tensor] | None = None,
        shared: Rewards | None = None,
    ):
        if settings.policy_reward not in POLICY_REWARDS:
            text = f"policy_reward {settings.policy_reward!r}: expected one of {', '.join(POLICY_REWARDS)}"
            raise InputError(text)
        self.domain, self.settings = demonstrations.domain, settings
        self.seed = seed = extend(
            seed, 101
        )  # streams of its own: a generator with the same seed shares nothing
        self.horizon = demonstrations.horizon
        states, actions, successors = demonstrations.transitions()
        self.x, self.x_next = (to_tensor(self.domain.network_input(s)) for s in (states, successors))
        self.actions = to_tensor(actions)
        m = demonstrations.n_demonstrations
        self.alpha = self.alpha if shared is None else shared.alpha
        self.policies = GaussianPolicies(self.domain, m, [*seed, 0])
        self.rewards, self.averaged_rewards = (
            Rewards(self.domain, m, settings.discount, [*seed, 2], self.alpha) for _ in range(2)
        )
        if shared is not None:
            for rewards in (self.rewards, self.averaged_rewards):
                rewards.task_reward.load_state_dict(shared.task_reward.state_dict())
                rewards.task_reward.requires_grad_(False)
        self.replay: deque[Samples] = deque(maxlen=settings.replay_iterations)
        self.coverage: list[Samples] = []
        self.steps = self.iteration = self.n_averaged = 0
        self.clone: Actor | None = None
        self.untrained = self.policies.actor()
        if networks is None and (settings.warm_start or settings.coverage):
            cloned, self.cloning_curve = clone_demonstrations(demonstrations, seed, settings.cloning_steps)
            self.clone = cloned.actor()
            self.policies = cloned if settings.warm_start else self.policies
        self.optimizer = PolicyOptimizer(
            self.policies, replace(settings.ppo, discount=settings.discount), [*seed, 3]
        )
        self.modules = {"policies": self.policies, "values": self.optimizer.values, "rewards": self.rewards,
                        "averaged": self.averaged_rewards}  # fmt: skip
        if networks is not None:
            self._restore(networks)
        learned = [p for p in self.rewards.parameters() if p.requires_grad]
        self.reward_optimizer = torch.optim.Adam(learned, lr=settings.discriminator_rate, fused=True)

    def networks(self) -> dict[str, torch.Tensor]:
        """Copies of all that a later learner needs, by name; the leading axis is the strategy's."""
        modules = self.modules.items()
        found = {f"{name}.{k}": v.clone() for name, module in modules for k, v in module.state_dict().items()}
        coverage = self._joined(self.coverage) if self.coverage else ()
        return found | {f"coverage.{i}": part for i, part in enumerate(coverage)}

    def _restore(self, networks: dict[str, torch.Tensor]) -> None:
        for name, module in self.modules.items():
            module.load_state_dict(under(name, networks))
        if "coverage.0" in networks:
            self.coverage = [(networks["coverage.0"], networks["coverage.1"], networks["coverage.2"])]

    def train(self, progress: Callable = iter) -> Iterator[dict]:
        """Run the iterations that are left; ``progress`` wraps the range (``tqdm`` for a bar).

        record: iteration; steps (per strategy, coverage included); discriminator_loss, accuracy and
        environment_return (M,) each - the return is for reading only and trains nothing; seconds by part.
        """
        if self.settings.coverage and not self.coverage:
            self._explore()
        for iteration in progress(range(self.iteration, self.settings.n_iterations)):
            clock = [time.perf_counter()]
            seeds = [[*self.seed, part, iteration] for part in (10, 11, 12, 13)]
            actor = self.policies.actor()
            data = rollout(self.domain, actor, self.settings.episodes, seeds[0], horizon=self.horizon)
            self.steps += data.n_steps // len(self.x)
            clock.append(time.perf_counter())
            self.replay.append(self._samples(data, actor, self.settings.replay_samples, seeds[1]))
            loss, accuracy = self._discriminate(seeds[2])
            self._average()
            clock.append(time.perf_counter())
            if self.learns_policies:
                shown, weight = (self.x, self.actions), self.settings.cloning_weight
                paid = self.policy_rewards(data)
                self.optimizer.update(data, paid, seeds[3], demonstrations=shown, cloning_weight=weight)
            clock.append(time.perf_counter())
            self.iteration = iteration + 1  # a reader may stop here and call ``train`` again
            yield {
                "iteration": iteration,
                "steps": self.steps,
                "discriminator_loss": loss,
                "accuracy": accuracy,
                "environment_return": data.returns.mean(1),
                "seconds": dict(zip(("rollouts", "discriminator", "policy"), np.diff(clock), strict=True)),
            }

    @one_thread()
    def policy_rewards(self, data: Rollouts) -> np.ndarray:
        """What the policy is paid: ``R_j(s')`` of the state reached, or ``f - log pi``; (M, E, T)."""
        m, e, t = data.rewards.shape
        x = to_tensor(self.domain.network_input(data.observations)).view(m, e, t + 1, -1)
        before, after = (part.reshape(m, e * t, -1) for part in (x[:, :, :-1], x[:, :, 1:]))
        with torch.no_grad():
            if self.settings.policy_reward == "g":
                return self.rewards.total(after).view(m, e, t).numpy()
            actions = to_tensor(data.executed_actions).view(m, e * t, -1)
            logits = self.rewards.f(before, after) - self.policies.log_density(before, actions)
            return logits.view(m, e, t).numpy()

    def _samples(self, data: Rollouts, actor: Policies, n_samples: int, seed: Seed) -> Samples:
        """``n_samples`` transitions per strategy: x, x', and the log-density they were drawn with."""
        e, t = data.rewards.shape[1:]
        flat = np.sort(np.random.default_rng(seed).permutation(e * t)[:n_samples])
        episode, step = np.divmod(flat, t)
        states, successors = data.observations[:, episode, step], data.observations[:, episode, step + 1]
        log_pi = actor.log_density(states, self.domain.clip_action(data.actions[:, episode, step]))
        x, x_next = (to_tensor(self.domain.network_input(s)) for s in (states, successors))
        return x, x_next, to_tensor(log_pi)

    def _explore(self) -> None:
        """Coverage: rollouts of the untrained policy and of the clone, made worse in several ways, once."""
        s, rng = self.settings, np.random.default_rng([*self.seed, 6])
        levels, clone = s.coverage_levels or self.domain.exploration.levels, self.clone
        assert clone is not None
        actor = Actor.joined([self.untrained, *(clone.disturbed(*level, rng) for level in levels)])
        data = rollout(self.domain, actor, s.coverage_episodes, [*self.seed, 4], horizon=self.horizon)
        self.steps += data.n_steps // len(self.x)
        parts = self._samples(data, actor, s.replay_samples, [*self.seed, 5])
        self.coverage = list(zip(*(part.split(len(self.x)) for part in parts), strict=True))

    @staticmethod
    def _joined(sources: Sequence[Samples]) -> Samples:
        x, x_next, log_pi = (torch.cat(parts, 1) for parts in zip(*sources, strict=True))
        return x, x_next, log_pi

    @one_thread()
    def _discriminate(self, seed: Seed) -> tuple[np.ndarray, np.ndarray]:
        """Cross-entropy steps on demonstrations against samples: loss and accuracy (M,) of the last one."""
        s, rng = self.settings, np.random.default_rng(seed)
        with torch.no_grad():
            log_pi = self.policies.log_density(
                self.x, self.actions
            )  # of the demonstrations, under the current policy
        pools = [self._joined(list(self.replay)), *([self._joined(self.coverage)] if s.coverage else [])]
        for _ in range(s.discriminator_steps):
            pick = torch.from_numpy(rng.integers(0, self.x.shape[1], s.discriminator_batch))
            drawn = [[part[:, pick] for part in (self.x, self.x_next, log_pi)]]
            for pool in pools:
                some = torch.from_numpy(
                    rng.integers(0, pool[0].shape[1], s.discriminator_batch // len(pools))
                )
                drawn.append([part[:, some] for part in pool])
            x, x_next, density = (torch.cat(parts, 1) for parts in zip(*drawn, strict=True))
            logits = self.rewards.f(x, x_next) - density
            demonstration, samples = logits[:, : s.discriminator_batch], logits[:, s.discriminator_batch :]
            loss = discriminator_loss(demonstration, samples)
            self.reward_optimizer.zero_grad()
            (loss.sum() + self.regularizer(drawn[1][0], rng)).backward()
            self.reward_optimizer.step()
        accuracy = ((demonstration > 0).float().mean(1) + (samples < 0).float().mean(1)) / 2
        return loss.detach().numpy().copy(), accuracy.numpy()

    def regularizer(self, x_samples: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
        """What a subclass adds to a step's loss; ``x_samples`` (M, n, obs_dim): reached by the policies."""
        return torch.zeros(())

    @torch.no_grad()
    def _average(self) -> None:
        decay = min(
            self.settings.reward_average, self.n_averaged / (self.n_averaged + 3)
        )  # forgets the start faster
        for mean, now in zip(self.averaged_rewards.parameters(), self.rewards.parameters(), strict=True):
            if now.requires_grad:
                mean.mul_(decay).add_(now, alpha=1 - decay)
        self.n_averaged += 1
