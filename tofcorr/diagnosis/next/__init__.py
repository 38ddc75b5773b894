"""What to record next, and what would have been found."""
