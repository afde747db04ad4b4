"""Values of environment parameters, as options write them: numbers, samplers and curricula; loads no torch."""
