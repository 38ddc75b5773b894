"""The corrector in the formats that robots load, each compared with the float64 model first."""
