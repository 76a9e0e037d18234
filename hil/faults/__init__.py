"""What can be made to go wrong with frames, drive and plant."""
