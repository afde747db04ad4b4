"""What all scenes share: the stepping loop, records, sensors, physics."""
