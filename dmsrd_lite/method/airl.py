"""Adversarial inverse reinforcement learning (AIRL) for many demonstrations at once.

``D(s, a, s') = e^f / (e^f + pi(a|s))`` with ``f = g(s) + gamma h(s') - h(s)``, so the discriminator's logit
is ``f - log pi(a|s)``. Paper: section "Preliminaries"; Fu, Luo, Levine (2018).
"""

import copy
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from dmsrd_lite.demonstrations import DemonstrationSet
from dmsrd_lite.domains import InputError
from dmsrd_lite.domains.domain import Seed, extend
from dmsrd_lite.learning.cloning import clone_behavior
from dmsrd_lite.learning.networks import Actor, GaussianPolicies, Policies, one_thread, to_tensor, under
from dmsrd_lite.learning.policy_optimization import PolicyOptimizer, PPOSettings
from dmsrd_lite.learning.rollouts import Rollouts, rollout
from dmsrd_lite.method.rewards import MeanRewards, Rewards

WORDS = {  # of the settings that are words
    "start": ("clone", "nothing"),
    "policy_base": ("g", "f"),
    "coverage": ("half", "once", "none"),
    "penalty_points": ("between",),
}
ENTROPY_WEIGHTS = (0.002, 0.1)  # within which c is tuned
REPLAY_SIZE = 100_000  # samples per strategy that a replay of all iterations holds at most
N_ANCHORS = 4000  # samples per strategy that go on to a later learner
Samples = tuple[torch.Tensor, ...]  # x and x' (M, n, obs_dim), log-density (M, n)


@dataclass(frozen=True)
class AIRLSettings:
    n_iterations: int = 30
    max_steps: int = 0  # ends with the iteration in which a strategy has spent so many; 0: n_iterations count
    episodes: int = 8  # per strategy and iteration
    discount: float = 0.99  # gamma, in f and for the policy
    start: str = "clone"  # policies start from behavioural cloning and stay near it, or from "nothing"
    first_sigma: float = 0.2  # of an untrained policy, share of half the action range
    policy_base: str = "g"  # what the policy is paid: "g" as in the paper, or "f" ...
    entropy_weight: float = 0.0  # ... less this weight c times log pi; "f" with c = 1 is log D - log(1 - D)
    entropy_tuning: float = 0.0  # how fast c follows the demonstrations (``tune_entropy``); 0: not at all
    cloning_weight: float = 1.0  # of the demonstration's negative log-likelihood in a clone's loss
    cloning_steps: int = 2000
    coverage: str = "half"  # exploratory rollouts: half of D's samples, or "once" in the replay, or "none"
    coverage_episodes: int = 2  # of the untrained policy and at each level of the clone (of it, without one)
    coverage_levels: tuple[tuple[float, float], ...] = ()  # as ``Domain.exploration``; (): the domain's
    discriminator_steps: int = 12
    discriminator_batch: int = 256  # demonstration samples per strategy and step, and as many others
    discriminator_rate: float = 3e-3
    penalty_weight: float = 0.0  # of the gradient penalty on the reward
    penalty_slope: float = 1.0  # up to which it is free
    penalty_points: str = "between"  # where it is asked: between a demonstration's and a sample's state
    first_horizon: int = 0  # episodes grow from so many steps, as the policies earn it; 0: whole at once
    growth: float = 1.05  # of an episode, whenever ...
    grow_below: float = 0.75  # ... the discriminator's smoothed accuracy (its 70 % quantile) is below this
    replay_iterations: int = 10  # policy samples of so many iterations are kept; 0: of all, thinned
    replay_samples: int = 2000  # per strategy and iteration
    anchor_samples: int = 40  # of every iteration, from nothing, for a later learner; 0: the replay's end
    n_iterates: int = 0  # rewards kept for their mean (``mean_of_iterates``), spread over the iterations
    iterates_share: float = 0.5  # which of them are used: the first ones
    reward_average: float = 0.9  # decay of the running average of the reward's weights; 0 keeps the last
    policy_average: float = 0.0  # decay of the running average of the policies' weights; 0 keeps the last
    last_rate: float = 1.0  # PPO's learning rate falls to this share of itself over the second half
    ppo: PPOSettings = PPOSettings(learning_rate=1e-4, epochs=1, sample_fraction=0.5)

    def __post_init__(self) -> None:
        for name, words in WORDS.items():
            if getattr(self, name) not in words:
                raise InputError(f"{name} {getattr(self, name)!r}: expected one of {', '.join(words)}")
        for name in ("penalty_weight", "entropy_weight", "entropy_tuning", "cloning_weight"):
            if not getattr(self, name) >= 0:
                raise InputError(f"{name} {getattr(self, name)!r}: expected a number of at least 0")
        for name, least in (("policy_average", 0.0), ("last_rate", 0.0), ("iterates_share", 1e-9)):
            if not least <= getattr(self, name) <= 1:
                raise InputError(f"{name} {getattr(self, name)!r}: expected a share of at most 1")
        if not 0 <= self.discount < 1:
            raise InputError(f"discount {self.discount!r}: expected a number of at least 0 and below 1")
        if self.max_steps < 0:
            raise InputError(f"max_steps {self.max_steps!r}: expected a number of steps, or 0 for no limit")
        if not self.penalty_slope > 0:
            raise InputError(f"penalty_slope {self.penalty_slope!r}: expected a positive number")
        if self.first_horizon < 0 or self.growth < 1 or (self.first_horizon and self.growth == 1):
            text = "expected a growth above 1 from a first horizon of at least 1 step, or 0: whole episodes"
            raise InputError(f"growth {self.growth!r} from first_horizon {self.first_horizon!r}: {text}")


def _evenly(samples: Samples, n: int) -> Samples:
    """``n`` of the samples (M, many, ...), evenly spread."""
    some = torch.linspace(0, samples[0].shape[1] - 1, n).long()
    return tuple(part[:, some] for part in samples)


@torch.no_grad()
def _follow(mean: torch.nn.Module, now: torch.nn.Module, decay: float) -> None:
    """The running average of what is learned: ``mean <- decay mean + (1 - decay) now``."""
    for average, parameter in zip(mean.parameters(), now.parameters(), strict=True):
        if parameter.requires_grad:
            average.mul_(decay).add_(parameter, alpha=1 - decay)


def discriminator_loss(demonstration_logits: torch.Tensor, sample_logits: torch.Tensor) -> torch.Tensor:
    """``-E_demo[log D] - E_samples[log(1 - D)]`` per strategy from logits (M, n): (M,) nats."""
    softplus = torch.nn.functional.softplus
    return softplus(-demonstration_logits).mean(1) + softplus(sample_logits).mean(1)


def clone_demonstrations(demonstrations: DemonstrationSet, seed: Seed, n_steps: int) -> GaussianPolicies:
    """A policy for each demonstration by behavioural cloning (``clone_behavior``)."""
    states, actions, _ = demonstrations.transitions()
    x = to_tensor(demonstrations.domain.network_input(states))
    policies = GaussianPolicies(demonstrations.domain, len(x), extend(seed, 0))
    clone_behavior(policies, x, to_tensor(actions), extend(seed, 1), n_steps)
    return policies


class AIRL:
    """One batched AIRL model per demonstration; ``train`` yields a record per iteration.

    From a clone it is the fast way. From nothing, as in the paper, it needs the gradient penalty and episodes
    that grow, or the discriminator is always right and nobody learns (lesson 02).

    After training: ``learned_policies`` and ``learned_rewards`` (means over iterations, where the settings
    ask for them), ``policies`` and ``rewards`` (the last iterates), ``clone`` (Actor of behavioural cloning),
    ``steps`` per strategy so far.
    ``networks``: those of an earlier learner (``networks()``) instead of a clone to start from. ``shared``:
    the rewards of an earlier learner, whose task reward is added to what is learned here, frozen; with
    ``task_learns`` a copy of it learns, too, as in MSRD.
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
        task_learns: bool = False,
    ):
        self.domain, self.settings = demonstrations.domain, settings
        self.seed = seed = extend(seed, 101)  # of its own: a generator with the same seed shares nothing
        self.horizon = demonstrations.horizon
        states, actions, successors = demonstrations.transitions()
        self.x, self.x_next = (to_tensor(self.domain.network_input(s)) for s in (states, successors))
        self.actions = to_tensor(actions)
        m, k = demonstrations.n_demonstrations, demonstrations.observations.shape[1]
        self.time = np.tile(np.arange(states.shape[1] // k), k)  # of each shown state within its trajectory
        if settings.first_horizon > self.horizon:
            text = f"expected at most the demonstrations' {self.horizon} steps to grow to"
            raise InputError(f"first_horizon {settings.first_horizon}: {text}")
        self.length = float(settings.first_horizon or self.horizon)  # of an episode now
        self.alpha = self.alpha if shared is None else shared.alpha
        self.policies = GaussianPolicies(self.domain, m, [*seed, 0], settings.first_sigma)
        self.rewards, self.averaged_rewards = (
            Rewards(self.domain, m, settings.discount, [*seed, 2], self.alpha) for _ in range(2)
        )
        if shared is not None:
            for rewards in (self.rewards, self.averaged_rewards):
                rewards.task_reward.load_state_dict(shared.task_reward.state_dict())
                rewards.task_reward.requires_grad_(task_learns)
        self.task_learns = task_learns
        self.replay: deque[Samples] = deque(maxlen=settings.replay_iterations or None)
        self.coverage: list[Samples] = []
        self.passed: list[Samples] = []  # a few of every iteration's samples, when the replay has forgotten
        self.anchors: list[Samples] = []  # what an earlier learner passed on the way
        self.iterates: list[Rewards] = []
        self.every = self.thinning = 1  # which iterations and samples are kept
        self.entropy_weights = np.full(m, settings.entropy_weight)  # c of each strategy
        self.smoothed: np.ndarray | None = None  # accuracy of the discriminator (M,)
        self.steps = self.iteration = self.n_averaged = 0
        self.clone: Actor | None = None
        self.untrained = self.policies.actor()
        if networks is None and settings.start == "clone":
            self.policies = clone_demonstrations(demonstrations, seed, settings.cloning_steps)
            self.clone = self.policies.actor()
        self.averaged_policies = copy.deepcopy(self.policies)
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
        """Copies of all that a later learner needs, by name; the leading axis is the strategy's.

        The entropy weights c are not kept: whoever goes on tunes them from the settings' anew.
        """
        modules = {**self.modules, "policies": self.learned_policies}.items()
        found = {f"{name}.{k}": v.clone() for name, module in modules for k, v in module.state_dict().items()}
        for name, samples in (("coverage", self.coverage), ("anchors", self.anchors or self._anchors())):
            parts = self._joined(samples) if samples else ()
            found |= {f"{name}.{i}": part for i, part in enumerate(parts)}
        return found

    def _anchors(self) -> list[Samples]:
        """From nothing a learner sees failure only on the way: an even choice of all that it passed."""
        kept = self.passed or list(self.replay)
        return [_evenly(self._joined(kept), N_ANCHORS)] if self.settings.start == "nothing" and kept else []

    def _restore(self, networks: dict[str, torch.Tensor]) -> None:
        for name, module in self.modules.items():
            module.load_state_dict(under(name, networks))
        self.averaged_policies.load_state_dict(self.policies.state_dict())
        for name in ("coverage", "anchors"):
            if f"{name}.0" in networks:
                setattr(self, name, [tuple(networks[f"{name}.{i}"] for i in range(3))])

    def train(self, progress: Callable = iter) -> Iterator[dict]:
        """Run the iterations that are left; ``progress`` wraps the range (``tqdm`` for a bar).

        record: iteration; horizon and number of its episodes; steps (per strategy, coverage included);
        discriminator_loss, accuracy, environment_return and entropy_weight (M,) each - the return is for
        reading only and trains nothing; seconds by part.
        """
        s = self.settings
        if s.coverage != "none" and not self.coverage and not self.anchors and not self.iteration:
            self._explore()
        for iteration in progress(range(self.iteration, s.n_iterations)):
            if s.max_steps and self.steps >= s.max_steps:
                break
            clock = [time.perf_counter()]
            seeds = [[*self.seed, part, iteration] for part in (10, 11, 12, 13)]
            actor, horizon = self.policies.actor(), int(self.length)
            many = min(100, s.episodes * self.horizon // (2 * horizon))  # while they are short
            episodes = max(s.episodes, many)
            data = rollout(self.domain, actor, episodes, seeds[0], horizon=horizon)
            self.steps += data.n_steps // len(self.x)
            clock.append(time.perf_counter())
            self._remember(self._samples(data, actor, s.replay_samples, seeds[1]))
            log_pi = self._log_densities()
            loss, accuracy = self._discriminate(seeds[2], log_pi)
            self._average()
            self._keep(iteration)
            self._grow(accuracy, iteration)
            clock.append(time.perf_counter())
            if self.learns_policies:
                shown, weight = (self.x, self.actions), s.cloning_weight if s.start == "clone" else 0.0
                if s.entropy_tuning:
                    flown = data.observations[:, :, :-1], data.executed_actions
                    states, acted = (part.reshape(len(self.x), -1, part.shape[-1]) for part in flown)
                    own = actor.log_density(states, acted)
                    self.tune_entropy(log_pi[:, self._near()].mean(1).numpy(), own.mean(1))
                share = max(iteration / s.n_iterations, self.steps / s.max_steps if s.max_steps else 0)
                self.optimizer.slow_down(1 - (1 - s.last_rate) * max(0.0, 2 * min(1.0, share) - 1))
                paid = self.policy_rewards(data)
                self.optimizer.update(data, paid, seeds[3], demonstrations=shown, cloning_weight=weight)
                if s.policy_average:
                    decay = min(s.policy_average, iteration / (iteration + 3))
                    _follow(self.averaged_policies, self.policies, decay)
            clock.append(time.perf_counter())
            self.iteration = iteration + 1  # a reader may stop here and call ``train`` again
            yield {
                "iteration": iteration,
                "horizon": horizon,
                "episodes": episodes,
                "steps": self.steps,
                "discriminator_loss": loss,
                "accuracy": accuracy,
                "environment_return": data.returns.mean(1),
                "entropy_weight": self.entropy_weights,
                "seconds": dict(zip(("rollouts", "discriminator", "policy"), np.diff(clock), strict=True)),
            }

    @one_thread()
    @torch.no_grad()
    def policy_rewards(self, data: Rollouts) -> np.ndarray:
        """What the policy is paid: ``R_j(s')`` of the state reached, or f, less ``c log pi``; (M, E, T)."""
        m, e, t = data.rewards.shape
        x = to_tensor(self.domain.network_input(data.observations)).view(m, e, t + 1, -1)
        before, after = (part.reshape(m, e * t, -1) for part in (x[:, :, :-1], x[:, :, 1:]))
        of_state = self.settings.policy_base == "g"
        paid = self.rewards.total(after) if of_state else self.rewards.f(before, after)
        if self.settings.entropy_weight:
            actions = to_tensor(data.executed_actions).view(m, e * t, -1)
            paid = paid - to_tensor(self.entropy_weights)[:, None] * self.policies.log_density(
                before, actions
            )
        return paid.view(m, e, t).numpy()

    @one_thread()
    @torch.no_grad()
    def _log_densities(self) -> torch.Tensor:
        """``log pi_j`` of every demonstrated action under the current policies, (M, n)."""
        return self.policies.log_density(self.x, self.actions)

    def _near(self) -> np.ndarray:
        """Which demonstrated steps an episode of the present length can reach."""
        return np.flatnonzero(self.time < int(self.length))

    def tune_entropy(self, shown: np.ndarray, own: np.ndarray) -> None:
        """``c <- c exp(-rate (E_demo[log pi] - E_pi[log pi]))`` within 0.002 and 0.1; the two (M,) given.

        They are equal where sigma is that of the demonstrated actions around the policy's mean: a policy that
        is wider finds what was shown likelier than what it does, and c falls.
        """
        change = np.exp(-self.settings.entropy_tuning * np.clip(shown - own, -1, 1))
        self.entropy_weights = np.clip(self.entropy_weights * change, *ENTROPY_WEIGHTS)

    def _remember(self, new: Samples) -> None:
        """Into the replay; of all iterations' samples every second is dropped whenever they get too many."""
        if self.settings.start == "nothing" and self.settings.anchor_samples:
            self.passed.append(_evenly(new, self.settings.anchor_samples))
        self.replay.append(tuple(part[:, :: self.thinning] for part in new))
        n_held = sum(x.shape[1] for x, *_ in self.replay)
        if not self.settings.replay_iterations and n_held > REPLAY_SIZE:
            self.thinning *= 2
            self.replay = deque(tuple(part[:, ::2] for part in held) for held in self.replay)

    def _grow(self, accuracy: np.ndarray, iteration: int) -> None:
        """Longer episodes once the discriminator can no longer tell policies from demonstrations."""
        before = accuracy if self.smoothed is None else self.smoothed
        self.smoothed = 0.7 * before + 0.3 * accuracy
        if iteration >= 10 and np.quantile(self.smoothed, 0.7) < self.settings.grow_below:
            self.length = min(self.horizon, self.length * self.settings.growth)

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
        """Coverage: rollouts of the untrained policy and of the clone, made worse in several ways, once.

        Without a clone it is the untrained policy that is made worse.
        """
        s, rng = self.settings, np.random.default_rng([*self.seed, 6])
        levels, known = s.coverage_levels or self.domain.exploration, self.clone or self.untrained
        actor = Actor.joined([self.untrained, *(known.disturbed(*level, rng) for level in levels)])
        data = rollout(self.domain, actor, s.coverage_episodes, [*self.seed, 4], horizon=self.horizon)
        self.steps += data.n_steps // len(self.x)
        parts = self._samples(data, actor, s.replay_samples, [*self.seed, 5])
        sources = list(zip(*(part.split(len(self.x)) for part in parts), strict=True))
        if s.coverage == "half":
            self.coverage = sources
        else:
            for source in sources:
                self._remember(source)

    @staticmethod
    def _joined(sources: Sequence[Samples]) -> Samples:
        return tuple(torch.cat(parts, 1) for parts in zip(*sources, strict=True))

    @one_thread()
    def _discriminate(self, seed: Seed, log_pi: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Cross-entropy steps on demonstrations (``log_pi``: of their actions, (M, n)) against samples: loss
        and accuracy (M,) of the last one."""
        s, rng = self.settings, np.random.default_rng(seed)
        pools = [self._joined([*self.anchors, *self.replay])]
        pools += [self._joined(self.coverage)] if self.coverage else []
        near = self._near()
        for _ in range(s.discriminator_steps):
            pick = torch.from_numpy(near[rng.integers(0, len(near), s.discriminator_batch)])
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
            extra = self.regularizer(drawn[1][0], rng)
            if s.penalty_weight:
                shown, reached = x[:, : 2 * (x.shape[1] // 2)].chunk(2, 1)
                extra = extra + s.penalty_weight * self.gradient_penalty(shown, reached, rng).sum()
            (loss.sum() + extra).backward()
            self.reward_optimizer.step()
        accuracy = ((demonstration > 0).float().mean(1) + (samples < 0).float().mean(1)) / 2
        return loss.detach().numpy().copy(), accuracy.numpy()

    def regularizer(self, x_samples: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
        """What is added to a step's loss; ``x_samples`` (M, n, obs_dim): reached by the policies.

        ``alpha sum_j E|g_j|`` where a task reward learns: what is common belongs there. A subclass adds more.
        """
        return (
            self.alpha * self.rewards.g(x_samples).abs().mean(1).sum()
            if self.task_learns
            else torch.zeros(())
        )

    def gradient_penalty(
        self, shown: torch.Tensor, samples: torch.Tensor, rng: np.random.Generator
    ) -> torch.Tensor:
        """``E max(0, |d R_j / d x| - slope)^2`` at network inputs x, (M,): shown and samples (M, n, obs_dim).

        At random points on the lines between pairs of them (Gulrajani et al., 2017, one-sided).
        """
        drawn = torch.from_numpy(rng.random((*shown.shape[:2], 1), dtype=np.float32))
        x = (drawn * shown + (1 - drawn) * samples).requires_grad_(True)
        slope = torch.autograd.grad(self.rewards.total(x).sum(), x, create_graph=True)[0].norm(dim=-1)
        return (slope - self.settings.penalty_slope).clamp(min=0).square().mean(1)

    def _keep(self, iteration: int) -> None:
        """An iterate of the rewards, of which at most ``n_iterates`` are held, evenly spread."""
        if self.settings.n_iterates and iteration % self.every == 0:
            self.iterates.append(copy.deepcopy(self.rewards))
            if len(self.iterates) > self.settings.n_iterates:
                self.iterates, self.every = self.iterates[::2], 2 * self.every

    def mean_of_iterates(self, share: float = 1.0) -> MeanRewards:
        """The mean of the reward functions over (the first ``share`` of) the iterations so far."""
        return MeanRewards(self.iterates[: max(1, round(share * len(self.iterates)))])

    @property
    def learned_policies(self) -> GaussianPolicies:
        """What is to be used: the running average of the policies, or the last ones."""
        return self.averaged_policies if self.settings.policy_average else self.policies

    @property
    def learned_rewards(self) -> Rewards | MeanRewards:
        """What is to be used: the mean of iterates where some are kept, else the running average."""
        return self.mean_of_iterates(self.settings.iterates_share) if self.iterates else self.averaged_rewards

    def _average(self) -> None:
        at_first = self.n_averaged / (self.n_averaged + 3)  # forgets the start faster
        decay = min(self.settings.reward_average, at_first)
        _follow(self.averaged_rewards, self.rewards, decay)
        self.n_averaged += 1
