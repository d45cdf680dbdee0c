"""stable-baselines3's PPO learns: the same with any vector environment.

stable_baselines3_ppo.py multiprocessing|fiber
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv


def main() -> None:
    vec_env_cls: Any = DummyVecEnv
    if sys.argv[1] == "fiber":
        from fiber.vector import VecEnv

        vec_env_cls = VecEnv
    torch.set_num_threads(1)
    env = make_vec_env("CartPole-v1", n_envs=4, seed=7, vec_env_cls=vec_env_cls)
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, seed=7, device="cpu")
    model.learn(2048)
    returns = [episode["r"] for episode in model.ep_info_buffer or ()]
    print("episodes", len(returns), "return", np.mean(returns))
    for name, parameter in model.policy.named_parameters():
        print(name, float(parameter.detach().abs().sum()).hex())
    env.close()


if __name__ == "__main__":
    main()
