"""Whatever bytes a file holds: it opens, or it is refused in words."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzzed import MANY, is_refused, read_or_refused
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_recordings import write_small_recording

from benchmarks import fuzz

FILES = ["recording.yaml", "frames.csv", "depth.npy", "amplitude.npy", "mask.npy", "raw.npy"]


@pytest.fixture(scope="module")
def targets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, fuzz.Target]:
    folder = tmp_path_factory.mktemp("fuzz")
    for name in ("recording", "full"):
        write_small_recording(folder / name)
    return {one.name: one for one in reversed(fuzz.recordings(folder))}


@pytest.mark.filterwarnings("ignore")  # What is drawn to be odd: numbers of other types.
@pytest.mark.parametrize("examples", [30, MANY])
@pytest.mark.parametrize("name", FILES)
def test_a_changed_file_opens_or_is_refused_in_words(
    targets: dict[str, fuzz.Target], name: str, examples: int, tmp_path: Path
) -> None:
    read_or_refused(targets[name], tmp_path, examples)


@settings(suppress_health_check=list[Any](HealthCheck))
@given(
    name=st.sampled_from(FILES),
    content=st.binary(max_size=300) | st.text(max_size=300).map(str.encode),
)
def test_arbitrary_bytes_are_refused_in_words(
    targets: dict[str, fuzz.Target], name: str, content: bytes, tmp_path: Path
) -> None:
    assert is_refused(targets[name], tmp_path, content)


def test_what_once_ended_otherwise_is_refused_in_words(
    targets: dict[str, fuzz.Target], tmp_path: Path
) -> None:
    header, table, depth = (targets[name].content for name in FILES[:3])
    archive = io.BytesIO()
    np.savez(archive, depth=np.ones((6, 5, 7), dtype=np.float32))
    hostile = {
        "recording.yaml": [
            *(b"!!bool maybe", b"format: !!int ''", b"format: !!timestamp x", b"? [a]\n: b"),
            *(b"[" * 5000, b"\x00", header.replace(b"width: 7", b"width: 0x" + b"f" * 5000)),
            header.replace(b"width: 7", b"width: 1" + b"0" * 400),
            header.replace(b"amplitude: 800.0", b"amplitude: '1e999'"),
            b"a: &a [x,x]\nb: &b [*a,*a]\nformat: tofcorr-recording\nversion: 1\ncamera: *b\n",
            b"format: tofcorr-recording\nversion: 1\ncamera: &c {width: *c}\n",
        ],
        "frames.csv": [table.replace(b"white", b"w" * 200_000, 1)],
        "depth.npy": [archive.getvalue(), depth.replace(b"(6, 5, 7)", b"(6, 5, ( ")],
    }
    for name, contents in hostile.items():
        for content in contents:
            assert content != targets[name].content
            assert is_refused(targets[name], tmp_path, content), content[:60]
    # Headers written by Python 2 are read.
    is_refused(targets["depth.npy"], tmp_path, depth.replace(b"(6, 5, 7)", b"(6L,5L,7)"))
