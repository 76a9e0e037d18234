"""The virtual joint: motor, reducer, friction, encoder, load."""
