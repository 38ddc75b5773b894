"""Pages for people: one dress, one file each, nothing fetched from elsewhere."""
