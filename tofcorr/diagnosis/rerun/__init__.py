"""The simulator run again, with the effects found."""
