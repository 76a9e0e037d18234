"""`jointctl doctor --motion`: a small pull on the joint before the first run, and what its encoders say to it."""
