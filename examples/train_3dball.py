"""Train 3DBall from Python, watching the return; see mappo_unity.train.

python examples/train_3dball.py                     # two minutes at most on two cores, without a GPU
python examples/train_3dball.py max_steps=20000     # any options of mappo-train
"""

from __future__ import annotations

import sys

from mappo_unity import train


def main(options: list[str]) -> None:
    """Train, and print how it went."""

    def watch(state):
        returns = state.recent_episodes.summary()
        print(f"{state.agent_steps:>9,} steps  mean return {returns['return_mean']:.1f}")

    outcome = train("env=3DBall", "seed=1", "stop_at_return=95", *options, after_iteration=watch)

    print(f"{outcome.status}: mean return {outcome.return_mean:.1f} after {outcome.wall_s:.1f} s")
    print(f"the best checkpoint is {outcome.best_checkpoint}")


if __name__ == "__main__":
    main(sys.argv[1:])
