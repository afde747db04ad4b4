"""Environments as `mlagents_envs.base_env.BaseEnv`: Unity's example scenes, embedded, and scenes like them.

`make_scene(name)` returns one, `scene_names()` lists them; README.md beside this file says how to write one.
"""

from mappo_unity.scenes.registry import make_scene as make_scene
from mappo_unity.scenes.registry import scene_names as scene_names
