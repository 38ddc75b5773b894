"""Single-pixel and few-zone sensors: rows of distances beside robot poses."""
