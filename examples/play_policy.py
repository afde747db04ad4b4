"""Load a trained policy and play it in a scene; see mappo_unity.load_policy.

python examples/play_policy.py 3DBall outputs/3DBall/2026-11-20_12-00-00
python examples/play_policy.py 3DBall random

What plays is a run folder, a checkpoint, an ONNX file, or chance.
"""

from __future__ import annotations

import argparse

from mappo_unity import load_policy, make_scene


def main(scene_name: str, where: str, num_episodes: int = 20) -> float:
    """Play so many episodes; return what an agent earned in one, on average."""
    policy = load_policy(where)
    env = make_scene(scene_name, seed=1)
    env.reset()
    running: dict[tuple[str, int], float] = {}  # behavior and agent: what its episode has earned so far
    returns: list[float] = []

    while len(returns) < num_episodes:
        for name, spec in env.behavior_specs.items():
            decision, terminal = env.get_steps(name)

            # Agents whose episode has just ended; team rewards stand beside the individual ones.
            for agent, reward, shared in zip(terminal.agent_id, terminal.reward, terminal.group_reward):
                returns.append(running.pop((name, int(agent)), 0.0) + float(reward + shared))
            policy.end(name, terminal.agent_id.tolist())
            policy.forget(name, terminal.agent_id.tolist())  # what it remembers is of the episode that ended

            # Agents that request a decision now.
            for agent, reward, shared in zip(decision.agent_id, decision.reward, decision.group_reward):
                running[name, int(agent)] = running.get((name, int(agent)), 0.0) + float(reward + shared)
            if len(decision):
                env.set_actions(name, policy.act(name, decision, spec))
        env.step()

    env.close()
    mean = sum(returns) / len(returns)
    print(f"{scene_name} played by {where}: mean return {mean:.2f} over {len(returns)} episodes")
    return mean


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", help="an embedded scene, such as 3DBall")
    parser.add_argument("policy", help="what plays")
    arguments = parser.parse_args()
    main(arguments.scene, arguments.policy)
