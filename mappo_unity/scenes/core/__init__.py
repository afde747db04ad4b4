"""What all scenes share: the stepping loop, records, sensors, physics, the contract of a BaseEnv."""
