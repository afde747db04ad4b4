"""PettingZoo's parallel environments as one `mlagents_envs.base_env.BaseEnv` (env.backend=pettingzoo)."""
