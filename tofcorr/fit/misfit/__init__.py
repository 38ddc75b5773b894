"""What a fitted model lacks, by what it leaves of the recordings."""
