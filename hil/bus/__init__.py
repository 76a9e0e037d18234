"""The virtual CAN bus: its process, arbitration and timing, frames."""
