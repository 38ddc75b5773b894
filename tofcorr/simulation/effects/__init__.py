"""Effects that a plain sensor lacks, one per file; `registry.CATALOGUE` lists them.

Each class holds its equation and source, its coefficients with physical priors, what it needs to
know, the stage of the simulator where it acts, and its columns in a linear fit. The simulator runs
the same class that the diagnosis fits. Whatever is asked about an effect, the effect answers.
"""

from tofcorr.simulation.effects.base import CatalogueEffect
from tofcorr.simulation.effects.patterns import MapEffect
from tofcorr.simulation.effects.registry import CATALOGUE

__all__ = ["CATALOGUE", "CatalogueEffect", "MapEffect"]
