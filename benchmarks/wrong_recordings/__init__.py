"""Recordings that keep the format and are wrong: each fault as a user would make it."""
