"""Models side by side: `evaluate` and `select`."""
