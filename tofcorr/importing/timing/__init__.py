"""Which pose belongs to which image: pairing by time, the lag between the clocks, and stops."""
