"""Long bags of large images are imported in bounded memory."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from importing.posed_scene import Drive, Recorded
from importing.rosbag import written_bags
from running import printed

from tofcorr.examples import bags

IMAGES = 2000
ENLARGED = 8

LIMIT_MB = 600
"""Of the whole process: 300 MB for torch and its libraries, 60 MB for the search of walls, which
looks at 90 planes however many images there are, the rest for single images. The depth images are
1230 MB as they are stored."""

RETURN_AT_ONCE = {"MALLOC_MMAP_THRESHOLD_": "65536"}
"""Makes the C library give every freed array back to the system: what remains is in use."""

# Not `ru_maxrss`: on Linux a process inherits that of the one that started it, here of all tests.
MEASURED = """
import sys
from pathlib import Path
from tofcorr.examples import bags
from tofcorr.cli.main import main
sys.argv = ["tofcorr", *sys.argv[1:]]
try:
    main()
except SystemExit as done:
    assert not done.code, done.code
status = Path("/proc/self/status").read_text()
print(int(status.split("VmHWM:")[1].split()[0]) // 1024)
"""


def enlarged(recorded: Recorded) -> Recorded:
    """Return the same camera with eight times as many pixels each way (filled in as written)."""
    matrix = recorded.matrix.copy()
    matrix[:2] *= ENLARGED
    matrix[:2, 2] += (ENLARGED - 1) / 2
    return replace(recorded, matrix=matrix, distortion=())


@pytest.mark.slow
def test_two_thousand_vga_frames_are_imported_in_bounded_memory(tmp_path: Path) -> None:
    drive = Drive(width=80, height=60, rate=IMAGES / 59.0, distortion=())
    recorded = drive.record()
    recorded = enlarged(recorded.take(np.arange(min(IMAGES, len(recorded.stop)))))
    path = written_bags.bag_path(tmp_path, "mcap")
    with bags.writing(path, "mcap") as bag:
        bag.camera_info(bags.INFO, recorded, size=(80 * ENLARGED, 60 * ENLARGED))
        written_bags.write_robot(bag, recorded)
        for time, depth in zip(recorded.image_times, recorded.depth_mm, strict=True):
            bag.image(bags.DEPTH, time, np.kron(depth, np.ones((8, 8), np.uint16)), "16UC1")
    arguments = [
        "import", "rosbag", path, "--depth", bags.DEPTH, "--base-frame", bags.BASE, "--tool-frame",
        bags.TOOL, "--out", tmp_path / "out",
    ]  # fmt: skip
    measured = (sys.executable, "-c", MEASURED, *arguments)
    said = printed(*measured, env=os.environ | RETURN_AT_ONCE)
    assert len(recorded.image_times) > 0.98 * IMAGES
    assert int(said.splitlines()[-1]) < LIMIT_MB, said
