"""The circumstances of a frame: named once, in the order of every conditions tensor."""

CONDITIONS = ("timestamp", "integration_time", "room_temperature", "body_temperature", "ambient")
"""Seconds, seconds, degrees Celsius twice, and the camera's own units of background light."""
