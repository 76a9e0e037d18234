"""Paired measurements of speed: ours against C, numpy and other loops."""
