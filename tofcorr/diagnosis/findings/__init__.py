"""What the sums say: where the gap lies, which effect causes it, how far it closes."""
