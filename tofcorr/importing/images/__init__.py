"""Images in files: found by name, decoded, and turned into metres."""
