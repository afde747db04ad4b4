"""Batches of experience, and what is taken out of them before they are learnt from."""
