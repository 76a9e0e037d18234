"""Controllers compared on many simulated joints, and the paper's experiments."""
