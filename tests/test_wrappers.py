"""The wrappers of mlagents-envs 1.1 (PettingZoo parallel and AEC, gym), unmodified, on mappo-player.

They cannot be installed beside this project (docs/your-own-game.md says why); MAPPO_WRAPPERS names a folder
that holds them:

    pip install --target FOLDER --no-deps --ignore-requires-python mlagents-envs==1.1.0 pettingzoo==1.15.0 \
        gym==0.26.2 gym-notices
    pip install --target FOLDER --no-deps gymnasium farama-notifications

They are played in a process of their own, which sees that folder first.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mappo_unity.cli.player import run as main

FOLDER = os.environ.get("MAPPO_WRAPPERS", "")
CLIENT = r"""
import json, os, sys, types
from mappo_unity.protocol.protobuf import install
install()
import mlagents_envs
# mlagents_envs.envs downloads a registry when it is imported; its modules alone do not
package = types.ModuleType("mlagents_envs.envs")
package.__path__ = [os.path.join(mlagents_envs.__path__[0], "envs")]
sys.modules["mlagents_envs.envs"] = package
from mlagents_envs.environment import UnityEnvironment
from mlagents_envs.exception import UnityWorkerInUseException

kind, player = sys.argv[1:]
areas = ["--num-areas", "1" if kind == "gym" else "3"]
for port in range(5605, 5705):
    try:
        env = UnityEnvironment(player, base_port=port, timeout_wait=60, additional_args=areas)
        break
    except UnityWorkerInUseException:
        pass
rewards, ends, size = [], 0, None
if kind == "parallel":
    from mlagents_envs.envs.unity_parallel_env import UnityParallelEnv
    wrapped = UnityParallelEnv(env, seed=0)
    obs = wrapped.reset()
    agents = len(wrapped.agents)
    for _ in range(60):
        obs, reward, done, _ = wrapped.step({a: wrapped.action_space(a).sample() for a in wrapped.agents})
        rewards += reward.values()
        ends += sum(done.values())
        size = {len(o) for o in obs.values()}
elif kind == "aec":
    from mlagents_envs.envs.unity_aec_env import UnityAECEnv
    wrapped = UnityAECEnv(env, seed=0)
    wrapped.reset()
    agents = len(wrapped.agents)
    for agent in wrapped.agent_iter(180):
        obs, reward, done, _ = wrapped.last()
        rewards.append(reward)
        ends += done
        size = {len(obs)}
        wrapped.step(None if done else wrapped.action_space(agent).sample())
else:
    from mlagents_envs.envs.unity_gym_env import UnityToGymWrapper
    wrapped = UnityToGymWrapper(env)
    wrapped.reset()
    agents = 1
    for _ in range(60):
        obs, reward, done, _ = wrapped.step(wrapped.action_space.sample())
        rewards.append(reward)
        size = {len(obs)}
        if done:
            ends += 1
            wrapped.reset()
wrapped.close()
rewards = [round(float(reward), 3) for reward in rewards]
print(json.dumps([mlagents_envs.__version__, agents, sorted(size), rewards, int(ends)]))
"""


@pytest.mark.skipif(not FOLDER, reason="MAPPO_WRAPPERS names no folder with mlagents-envs 1.1 and pettingzoo")
@pytest.mark.parametrize("kind", ["parallel", "aec", "gym"])
def test_wrappers_play_3dball(kind: str, tmp_path: Path) -> None:
    assert main(["build", "3DBall", str(tmp_path)]) == 0
    environment = os.environ | {"PYTHONPATH": FOLDER}
    command = [sys.executable, "-c", CLIENT, kind, str(tmp_path / "3DBall")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr
    version, agents, size, rewards, ends = json.loads(done.stdout.splitlines()[-1])
    assert version == "1.1.0" and agents == (1 if kind == "gym" else 3) and size == [8]
    assert set(rewards) <= {0.0, 0.1, -1.0} and 0.1 in rewards
    assert rewards.count(-1.0) == ends > 0  # a ball falls: -1, and the end
