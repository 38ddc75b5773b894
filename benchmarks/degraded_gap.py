"""How far a found sensor closes the gap: degraded ideal frames against real ones, held out.

    python -m benchmarks.degraded_gap RECORDING [--ideal IDEAL] [--config NAME] [--seeds 1 2 3]
    python -m benchmarks.degraded_gap --simulated 5 [--seeds 1]

Half of the poses are diagnosed; the sensor that this gives degrades ideal frames of the other half.
`--simulated N` does so for N cameras of the built-in simulator, each with D, P and I errors, dark
pixels missing, and one effect of a few millimetres. `<= 1.1`: degraded frames leave at most 1.1
times the stage with effects; `open`: more, but not significantly (one-sided, 5 %).
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.rerun.degraded_gap import DegradedGap, degraded_gap
from tofcorr.options import resolve_options
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate

# What degraded frames may leave at most, times the gap of the stage with effects.
_MOST = 1.1

EFFECTS: tuple[dict[str, Any], ...] = (
    {"name": "wiggling", "sin_4": 0.012, "cos_4": 0.006},
    {"name": "integration_time", "log_1": -0.01},
    {"name": "incidence_angle", "square": 0.3},
    {"name": "ambient_light", "reference_counts": 200.0, "linear": 0.008},
    {"name": "mixed_pixels", "share_1.2px": 0.8},
)


def simulated(number: int, seed: int, out: Path) -> Recording:
    """Simulate a camera with one effect."""
    options = resolve_options(SimulatorOptions, "diagnosis").to_mapping()
    options["shots"] = [{"target": "white", "poses": 30}, {"target": "checkerboard", "poses": 50}]
    # The converter never saturates; pixels darker than this have no distance.
    readout = options["sensor"]["readout"] | {
        "converter_bits": 24,
        "least_amplitude_counts": 1500.0,
    }
    options["sensor"]["readout"] = readout
    options["effects"] = [EFFECTS[number % len(EFFECTS)]]
    return simulate(options | {"seed": 1000 * seed + number}, out)


def line(name: str, found: DegradedGap) -> str:
    """Return a row of the table."""
    within = {True: "yes", None: "open", False: "no"}[found.within(_MOST)]
    low, high = (1e3 * end for end in found.degraded_interval)
    return (
        f"{name:>22} {found.poses:5d} {1e3 * found.ideal:7.2f} {1e3 * found.with_effects:8.2f} "
        f"{1e3 * found.degraded:9.2f} [{low:5.2f}, {high:5.2f}] {within:>6} "
        f"{1e3 * found.noise[0]:7.2f} {1e3 * found.noise[1]:7.2f} "
        f"{found.dropouts[0]:8.4f} {found.dropouts[1]:8.4f} {found.covered_share:8.3f}  "
        f"{', '.join(found.diagnosis.effects)}"
    )


def main() -> None:
    """Print one row for every recording and seed."""
    parser = argparse.ArgumentParser(description="How far a found sensor closes the gap.")
    parser.add_argument("recording", nargs="?", type=Path)
    parser.add_argument("--ideal", type=Path)
    parser.add_argument("--config", default="default")
    parser.add_argument("--simulated", type=int, default=0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    given = parser.parse_args()
    print(
        f"{'camera':>22} poses   ideal  effects  degraded  95 % interval  <= 1.1    noise, mm      "
        "missing pixels  covered  named\n"
        f"{'':>22}  held      mm       mm        mm                            real degr.     "
        "real     degr."
    )
    ideal = None if given.ideal is None else Recording.open(given.ideal)
    for seed in given.seeds:
        if given.recording is not None:
            real = Recording.open(given.recording)
            found = degraded_gap(real, given.config, ideal=ideal, seed=seed)
            print(line(f"{given.recording.name}, seed {seed}", found), flush=True)
        for number in range(given.simulated):
            with tempfile.TemporaryDirectory() as folder:
                real = simulated(number, seed, Path(folder) / "real")
                found = degraded_gap(real, given.config, seed=seed)
            name = str(EFFECTS[number % len(EFFECTS)]["name"])
            print(line(f"{name}, seed {seed}", found), flush=True)


if __name__ == "__main__":
    main()
