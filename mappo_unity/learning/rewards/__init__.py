"""Reward streams beside the environment's own: what a policy earns for what it does not know yet."""
