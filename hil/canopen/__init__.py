"""The virtual CiA 301/402 drive and the CiA 406 encoder node, without I/O."""
