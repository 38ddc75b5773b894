"""Which pixels and images count, and how much."""
