"""Random faults against the virtual joint, and what must hold whatever happens (`jointctl fault-campaign`)."""
