"""Environment parameters that change while a run learns."""
