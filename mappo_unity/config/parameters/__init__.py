"""Values of environment parameters as options write them: numbers, samplers, curricula; loads no torch."""
