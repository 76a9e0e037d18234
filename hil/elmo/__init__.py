"""The virtual drive with the ASCII interpreter on a pseudo-terminal."""
