"""The simulator under diagnosis, in whichever form a user has it."""
