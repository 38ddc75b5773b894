"""The renewed check on withheld effects: other physics, other forms, wide ranges, opened once."""
