"""Networks: observations of agents in, actions and values out."""
