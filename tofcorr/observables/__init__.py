"""What a camera shows beside its bias: noise, missing pixels, amplitude; measured and compared."""
