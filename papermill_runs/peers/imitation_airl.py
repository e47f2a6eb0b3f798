"""`imitation`'s AIRL on the demonstration that lesson 02 learns from, beside ours: same task, steps, score.

Two environments, because `imitation` needs older packages (requirements.txt, Python 3.11):

    python3.11 -m venv peer && peer/bin/pip install -r papermill_runs/peers/requirements.txt
    peer/bin/python papermill_runs/peers/imitation_airl.py train peer.npz
    .venv/bin/python papermill_runs/peers/imitation_airl.py score peer.npz

`train` runs their AIRL with the settings of their tutorial and writes its policy now and then; `score`
trains ours for as many steps, one after the other on the same machine, scores both with
`metrics.score_policies`, and writes `imitation_airl.json` beside this file. Ours learns from ten people at
once as well, for the speed.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np

HERE, PERSON, SEED = Path(__file__).resolve().parent, 1, 0
N_STEPS = 410_000  # about what lesson 02 spends on one person
SNAPSHOTS = 5


def train(output: str) -> None:
    """In the peer's environment: write the mean network and sigma after equal parts of ``N_STEPS``."""
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
    kept, seconds, steps = {}, 0.0, 0
    for k in range(SNAPSHOTS):
        before = time.perf_counter()
        airl.train(N_STEPS // SNAPSHOTS)
        seconds += time.perf_counter() - before
        steps += N_STEPS // SNAPSHOTS
        policy = learner.policy
        layers = [policy.mlp_extractor.policy_net[0], policy.mlp_extractor.policy_net[2], policy.action_net]
        for i, layer in enumerate(layers):
            kept[f"{k}.weight{i}"] = layer.weight.detach().numpy().T.copy()
            kept[f"{k}.bias{i}"] = layer.bias.detach().numpy().copy()
        kept[f"{k}.sigma"] = policy.log_std.detach().exp().numpy()
        kept[f"{k}.spent"] = np.array([steps, seconds])
        np.savez(output, **kept)
        print(f"{steps:,} steps, {seconds:.0f} s", flush=True)


def score(kept: str) -> None:
    """In this repository's environment: the same score for theirs and ours."""
    from dmsrd_lite.demonstrations import load_shipped
    from dmsrd_lite.domains import INVERTED_PENDULUM as domain
    from dmsrd_lite.evaluation.metrics import score_policies
    from dmsrd_lite.learning.networks import Actor
    from dmsrd_lite.method.airl import AIRL
    from dmsrd_lite.method.divergence import divergence_floor
    from dmsrd_lite.workbook import presets
    from dmsrd_lite.workbook.bench import from_nothing
    from dmsrd_lite.workbook.records import machine, versions

    shown, again = (load_shipped(domain, kind).select([PERSON]) for kind in ("demonstrations", "second_take"))
    floor, rows = float(divergence_floor(shown, again)[0]), []

    def add(method: str, actor: Actor, steps: float, seconds: float) -> None:
        found = {k: round(float(v[0]), 3) for k, v in score_policies(actor, shown, [SEED, 99]).items()}
        rows.append({"method": method, "steps": int(steps), "seconds": round(float(seconds), 1),
                     "steps_per_s": round(steps / seconds), **found})  # fmt: skip
        print(rows[-1], flush=True)

    with np.load(kept) as theirs:
        for k in range(SNAPSHOTS):
            # their network sees raw states: our scaling is folded into the first layer
            scale = np.asarray(domain.observation_scale)[:, None]
            weights = [theirs[f"{k}.weight{i}"] * (scale if i == 0 else 1) for i in range(3)]
            biases = [theirs[f"{k}.bias{i}"] for i in range(3)]
            layers = [[part[None].astype(np.float32) for part in parts] for parts in (weights, biases)]
            layers[1] = [part[:, None] for part in layers[1]]
            actor = Actor(domain, *layers, theirs[f"{k}.sigma"][None, None].astype(np.float32))
            add("imitation's AIRL", actor, *theirs[f"{k}.spent"])
    settings = presets.choose("02_airl", domain.name, "quick").live
    learner, seconds = AIRL(shown, settings, SEED), 0.0
    for record in learner.train():
        seconds += sum(record["seconds"].values())
        if record["iteration"] % 20 == 19:
            add("ours", learner.learned_policies.actor(), record["steps"], seconds)
    ten = from_nothing(range(10), SEED, 60)
    print(ten)
    text = {"person": PERSON, "seed": SEED, "floor": floor, "rows": rows, "ten_people": ten,
            "machine": machine(), "versions": versions()}  # fmt: skip
    (HERE / "imitation_airl.json").write_text(json.dumps(text, indent=1) + "\n")


if __name__ == "__main__":
    {"train": train, "score": score}[sys.argv[1]](sys.argv[2])
