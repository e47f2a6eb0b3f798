"""`imitation`'s AIRL on the demonstration that lesson 02 learns from, beside ours: same task, steps, score.

Two environments, because `imitation` needs older packages (requirements.txt, Python 3.11):

    python3.11 -m venv peer && peer/bin/pip install -r papermill_runs/peers/requirements.txt
    peer/bin/python papermill_runs/peers/imitation_airl.py train peer.npz
    .venv/bin/python papermill_runs/peers/imitation_airl.py score peer.npz

`train` runs their AIRL with the settings of their tutorial and writes its policy now and then; `score`
trains ours for as many steps and once more for as many seconds, one after the other on the same machine,
scores all with `metrics.score_policies`, and writes `imitation_airl.json` beside this file. Ours learns from
ten people at once as well, for the speed. Seconds are the processor's (of all threads), so that a machine
that does other things besides makes nobody slower.
"""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

HERE, PERSON, SEED = Path(__file__).resolve().parent, 1, 0
ROUND = 16_384  # steps between two updates of their discriminator: 8 environments, 2048 steps
LOOKS = (1, 2, 5, 10, 15, 20, 25)  # after so many rounds; the last: about what lesson 02 spends on one person


def train(output: str) -> None:
    """In the peer's environment: write the mean network and sigma after each of ``LOOKS``."""
    import gymnasium as gym
    import torch
    from gymnasium.envs.mujoco.inverted_pendulum_v4 import InvertedPendulumEnv
    from imitation.algorithms.adversarial.airl import AIRL
    from imitation.data.types import Trajectory
    from imitation.rewards.reward_nets import BasicShapedRewardNet
    from imitation.util.networks import RunningNorm
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import DummyVecEnv

    torch.set_num_threads(1)

    class Pendulum(InvertedPendulumEnv):
        """Our task: never ends early, -|theta| of the new state."""

        def step(self, action):
            self.do_simulation(np.clip(action, -3, 3), self.frame_skip)
            state = self._get_obs()
            return state, -abs(float(state[1])), False, False, {}

    def make() -> gym.Env:
        return gym.wrappers.TimeLimit(Pendulum(), 1000)

    with np.load(HERE.parent.parent / "data" / "inverted_pendulum_demonstrations.npz") as data:
        shown = [
            Trajectory(o.astype(np.float32), a.astype(np.float32), None, terminal=True)
            for o, a in zip(data["observations"][PERSON], data["actions"][PERSON], strict=True)
        ]
    envs = DummyVecEnv([make] * 8)
    envs.seed(SEED)
    learner = PPO("MlpPolicy", envs, batch_size=64, ent_coef=0.0, learning_rate=5e-4, gamma=0.95,
                  clip_range=0.1, vf_coef=0.1, n_epochs=5, seed=SEED)  # fmt: skip
    net = BasicShapedRewardNet(envs.observation_space, envs.action_space, normalize_input_layer=RunningNorm)
    airl = AIRL(demonstrations=shown, demo_batch_size=2048, gen_replay_buffer_capacity=512, venv=envs,
                n_disc_updates_per_round=16, gen_algo=learner, reward_net=net)  # fmt: skip
    kept, seconds, done = {}, 0.0, 0
    for k, look in enumerate(LOOKS):
        before = time.process_time()
        airl.train((look - done) * ROUND)
        seconds, done = seconds + time.process_time() - before, look
        policy = learner.policy
        layers = [policy.mlp_extractor.policy_net[0], policy.mlp_extractor.policy_net[2], policy.action_net]
        for i, layer in enumerate(layers):
            kept[f"{k}.weight{i}"] = layer.weight.detach().numpy().T.copy()
            kept[f"{k}.bias{i}"] = layer.bias.detach().numpy().copy()
        kept[f"{k}.sigma"] = policy.log_std.detach().exp().numpy()
        kept[f"{k}.spent"] = np.array([look * ROUND, seconds])
        np.savez(output, **kept)
        print(f"{look * ROUND:,} steps, {seconds:.0f} s", flush=True)


def score(kept: str) -> None:
    """In this repository's environment: the same score for theirs and ours."""
    from dmsrd_lite.demonstrations import load_shipped
    from dmsrd_lite.domains import INVERTED_PENDULUM as domain
    from dmsrd_lite.evaluation.metrics import score_policies
    from dmsrd_lite.learning.networks import Actor
    from dmsrd_lite.method.airl import AIRL, AIRLSettings
    from dmsrd_lite.method.divergence import divergence_floor
    from dmsrd_lite.workbook import presets
    from dmsrd_lite.workbook.records import machine, versions

    shown, again = (load_shipped(domain, kind).select([PERSON]) for kind in ("demonstrations", "second_take"))
    floor, rows = float(divergence_floor(shown, again)[0]), []

    def add(method: str, actor: Actor, steps: float, seconds: float) -> None:
        found = {k: round(float(v[0]), 3) for k, v in score_policies(actor, shown, [SEED, 99]).items()}
        rows.append({"method": method, "steps": int(steps), "seconds": round(float(seconds), 1),
                     "steps_per_s": round(steps / seconds), **found})  # fmt: skip
        print(rows[-1], flush=True)

    with np.load(kept) as theirs:
        for k in range(len(LOOKS)):
            # their network sees raw states: our scaling is folded into the first layer
            scale = np.asarray(domain.observation_scale)[:, None]
            weights = [theirs[f"{k}.weight{i}"] * (scale if i == 0 else 1) for i in range(3)]
            biases = [theirs[f"{k}.bias{i}"] for i in range(3)]
            layers = [[part[None].astype(np.float32) for part in parts] for parts in (weights, biases)]
            layers[1] = [part[:, None] for part in layers[1]]
            actor = Actor(domain, *layers, theirs[f"{k}.sigma"][None, None].astype(np.float32))
            add("imitation's AIRL", actor, *theirs[f"{k}.spent"])
            theirs_seconds = float(theirs[f"{k}.spent"][1])

    def train_ours(name: str, people: list[int], settings: AIRLSettings, n_looks: int) -> None:
        """Ours, scored after equal parts of the training; of several people only the speed."""
        learner, seconds, seen = AIRL(load_shipped(domain).select(people), settings, SEED), 0.0, 0
        before = time.process_time()
        for record in learner.train():
            seconds += time.process_time() - before
            share = (record["iteration"] + 1) / settings.n_iterations
            share = max(share, record["steps"] / settings.max_steps if settings.max_steps else 0)
            if share * n_looks >= seen + 1:
                seen += 1
                if len(people) == 1:
                    add(name, learner.learned_policies.actor(), record["steps"], seconds)
            speed[name] = round(len(people) * record["steps"] / seconds)
            before = time.process_time()

    settings, speed = presets.choose("02_airl", domain.name, "quick").live, dict[str, int]()
    train_ours("ours", [PERSON], settings, 5)
    longer = replace(settings, n_iterations=100_000, max_steps=round(speed["ours"] * theirs_seconds))
    train_ours("ours, for as long", [PERSON], longer, 5)
    train_ours("ours, ten people at once", list(range(10)), replace(settings, n_iterations=60), 1)
    ten = {"steps_per_s": speed["ours, ten people at once"]}
    text = {"person": PERSON, "seed": SEED, "floor": floor, "rows": rows, "ten_people": ten,
            "machine": machine(), "versions": versions()}  # fmt: skip
    (HERE / "imitation_airl.json").write_text(json.dumps(text, indent=1) + "\n")


if __name__ == "__main__":
    {"train": train, "score": score}[sys.argv[1]](sys.argv[2])
