"""A new effect: simulated, and diagnosed."""

from tofcorr.cli.main import group

simulate = "simulate --config ../simulator.yaml --out recording"
diagnose = "diagnose --recording recording --config ../diagnose.yaml --out report"
for words in (simulate, diagnose):
    group(words.split(), standalone_mode=False)
