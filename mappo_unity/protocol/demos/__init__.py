"""Demonstrations: what agents saw, did and earned, in Unity's files (.demo), read and written.

`demo_file`: the bytes. `reader`: files to a `Demonstration`. `writer`, `recording_env`: what a BaseEnv plays
to files. Knows nothing of learning.
"""
