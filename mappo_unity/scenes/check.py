"""Check a scene or any BaseEnv: ``python -m mappo_unity.scenes.check NAME``; see `scenes.contract.check`."""

from mappo_unity.scenes.contract.check import main

if __name__ == "__main__":
    raise SystemExit(main())
