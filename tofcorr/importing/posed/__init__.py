"""Depth images from a moving robot: poses, clocks, stops and walls, whatever door they came by."""
