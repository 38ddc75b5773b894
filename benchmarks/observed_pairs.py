"""Noise and missing pixels of eight kinds of camera, each against a simulator that lacks something.

    python -m benchmarks.observed_pairs --seed SEED [--pairs 12]

Camera and simulator are those of `benchmarks.numpy_camera`; both saw the same 24 poses. Half of the
pairs have one frame a pose, half have three. `right` is a simulator with all that the camera has:
nothing should be reported. Shares stand with their 95 % intervals (Wilson).
"""

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.numpy_camera import Camera, record
from benchmarks.withheld.statistics import Share, share
from tofcorr.observables import compare_observables

# What counts as right: of the ratio of noises, and of each share of missing pixels. From issue 15.
_RATIO_WITHIN, _SHARE_WITHIN = 0.05, 0.002

PLAIN = Camera(shot=0.8e-3, read=0.3e-3)
FILTERED = replace(PLAIN, threshold=120.0, filter_px=0.7)
KINDS: dict[str, tuple[Camera, Camera]] = {
    "shot noise": (replace(PLAIN, shot=2.5e-3), PLAIN),
    "read noise": (replace(PLAIN, read=2.0e-3), PLAIN),
    "shot and read noise": (replace(PLAIN, shot=2.0e-3, read=1.5e-3), PLAIN),
    "dark pixels missing": (replace(PLAIN, threshold=120.0, base_share=0.003), PLAIN),
    "bright pixels saturated": (replace(PLAIN, saturation=900.0), PLAIN),
    "neighbours correlated": (replace(PLAIN, filter_px=0.8), PLAIN),
    "frames mixed": (replace(PLAIN, mixed_frames=0.6), PLAIN),
    "right": (FILTERED, FILTERED),
}
"""By name: the camera, and the simulator that lacks something of it."""


@dataclass(frozen=True)
class Found:
    """What a comparison says of a pair, beside what was drawn."""

    ratio: float  # of the noises, said over true
    shares: tuple[float, float]  # of missing pixels, said less true: camera, simulator
    causes: tuple[str, ...]


def compare(kind: str, seed: int, number: int, folder: Path) -> Found:
    """Draw a pair and compare it."""
    poses, repeats = 1000 * seed + number, 3 if number % 2 else 1
    sides = [
        record(folder / name, camera, 2 * poses + side, poses_seed=poses, repeats=repeats)
        for side, (name, camera) in enumerate(zip(("real", "sim"), KINDS[kind], strict=True))
    ]
    found = compare_observables(sides[0].recording, sides[1].recording, seed=number)
    assert found.noise is not None
    assert found.noise.ratio is not None
    assert found.dropouts is not None
    both = np.isfinite(sides[0].variance + sides[1].variance)
    true = sides[0].variance[both].mean() / sides[1].variance[both].mean()
    said = found.dropouts.real_share, found.dropouts.sim_share
    return Found(
        float(found.noise.ratio / true**0.5),
        (said[0] - sides[0].missing_share, said[1] - sides[1].missing_share),
        found.explained_by,
    )


def line(kind: str, pairs: list[Found]) -> str:
    """Return a row of the table."""
    right = share(abs(one.ratio - 1) <= _RATIO_WITHIN for one in pairs)
    shares = share(max(map(abs, one.shares)) <= _SHARE_WITHIN for one in pairs)
    named: dict[str, int] = {}
    for one in pairs:
        for cause in one.causes or ("nothing",):
            named[cause] = named.get(cause, 0) + 1
    told = ", ".join(f"{cause} {count}" for cause, count in sorted(named.items()))
    ratios = [one.ratio for one in pairs]
    return (
        f"{kind:>24}  {_text(right)}  {min(ratios):.3f}-{max(ratios):.3f}  {_text(shares)}  {told}"
    )


def _text(counted: Share) -> str:
    low, high = counted.interval
    return f"{counted.value:.2f} [{low:.2f}, {high:.2f}]"


def main() -> None:
    """Print one row for every kind."""
    parser = argparse.ArgumentParser(description="Noise and missing pixels of pairs.")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--pairs", type=int, default=12)
    given = parser.parse_args()
    print(
        f"{'':>24}  ratio within 5 %   said over true  shares within 0.002  explained by\n"
        f"{'lacking':>24}  (Wilson)           least-largest   (Wilson)             (pairs)"
    )
    for kind in KINDS:
        pairs = []
        for number in range(given.pairs):
            with tempfile.TemporaryDirectory() as folder:
                pairs.append(compare(kind, given.seed, number, Path(folder)))
        print(line(kind, pairs), flush=True)


if __name__ == "__main__":
    main()
