"""Self-play against past policies: the pool, who is met, and how the learner fares."""
