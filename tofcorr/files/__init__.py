"""Files that appear whole or not at all, and that say so themselves when they were damaged."""
