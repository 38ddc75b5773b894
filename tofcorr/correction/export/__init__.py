"""The corrector in the formats that robots load, each compared with the float64 model first."""

from tofcorr.correction.export.registry import export as export
