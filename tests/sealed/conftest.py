import pytest
import threadpoolctl

from benchmarks import levels
from benchmarks.renewed import ranges


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small images, few frames, and one thread, for threads of small matrices cost more."""
    few = {"images": {(32, 24): 1.0}, "frames": {12: 1.0}}
    for name, value in few.items():
        monkeypatch.setitem(ranges.RANGES, name, value)
        monkeypatch.setitem(ranges.PLAIN, name, value)
    monkeypatch.setitem(ranges.RANGES, "outdoor", 0.0)
    monkeypatch.setattr(levels, "IMAGES", few["images"])
    monkeypatch.setattr(levels, "FRAMES", {kind: {15: 1.0} for kind in levels.FRAMES})
    threadpoolctl.threadpool_limits(1)
