"""The stated ranges of every scene: where an episode begins, and where bodies may be at all times.

A module a scene, named after its package. In: a scene, whose hooks are watched while somebody plays it
(`ranges.py`). Out: the lowest and highest values seen, and faults. Constants are those of Unity's scenes
(docs/scenes/), typed here once more and not read from the scenes' modules, so that a slip there is found
here. `soak_scenes.py` finds a scene's class by its record (`mappo_unity/scenes/registry.py`).

Coordinates as in the scenes: x right, y up, z forward, metres. Legend: n begun episodes, N areas.
"""
