"""The ML-Agents protocol (API 1.5.0) between a trainer and Unity players, from both ends.

`messages` and `batch_encoding`: bytes on the wire. `server`, `process`, `client`: a trainer's side, one
running player as a BaseEnv. `restarting_player`, `parallel_players`: players that fail, and many of them.
`serve`: a scene as a player. `demos`: recordings in files. Knows nothing of learning.
"""

import os

from mappo_unity.protocol.protobuf import install

# No child of ours uses gRPC before it execs. Its fork handlers run in every child all the same (players that
# are started again, ffmpeg), and now and then kill it there; gRPC reads this when it is imported.
os.environ.setdefault("GRPC_ENABLE_FORK_SUPPORT", "0")

install()
