"""The ML-Agents protocol (API 1.5.0) between a trainer and Unity players, from both ends.

`messages` and `rows`: bytes on the wire. `server`, `process`, `client`: a trainer's side, one running player
as a BaseEnv. `restarts`, `several`: players that fail, and many of them. Knows nothing of learning.
"""

from mappo_unity.protobuf import install

install()
