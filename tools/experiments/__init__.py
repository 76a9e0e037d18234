"""Controllers compared on many simulated joints, the paper's experiments, and campaigns of random faults."""
