"""The checks: each is a function of what is looked at, and yields what it finds."""
