"""The contract of a BaseEnv: its rules, and what checks an environment against them by playing it."""
