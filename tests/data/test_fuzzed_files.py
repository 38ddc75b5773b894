"""Whatever bytes a file holds: it opens, or it is refused in words. Nothing else ever comes out."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from broken_recordings import put
from hypothesis import example, given, settings
from hypothesis import strategies as st
from small_recordings import write_small_recording

from tofcorr.data.recording import Recording
from tofcorr.errors import CalibrationDataError

FILES = ["recording.yaml", "frames.csv", "depth.npy", "amplitude.npy", "mask.npy", "raw.npy"]
FUZZ = settings(max_examples=150, deadline=None)

Edit = tuple[float, int, bytes]
edits = st.lists(
    st.tuples(st.floats(0, 1), st.integers(0, 8), st.binary(max_size=8)), min_size=1, max_size=4
)


@pytest.fixture(scope="module")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_recording(tmp_path_factory.mktemp("fuzz") / "recording")


def opens_or_is_refused(folder: Path, name: str, content: bytes) -> bool:
    """Open the recording with one file replaced, and put the file back."""
    path = folder / name
    before = path.read_bytes()
    path.write_bytes(content)
    refusal = None
    try:
        Recording.open(folder)
    except CalibrationDataError as error:
        refusal = str(error)
    finally:
        path.write_bytes(before)
    assert refusal is None or (name in refusal and "\n" not in refusal)
    return refusal is None


def edited(content: bytes, changes: list[Edit], reach: int) -> bytes:
    """Replace `removed` bytes at some share of the first `reach` bytes by others."""
    for place, removed, new in changes:
        start = int(place * min(reach, len(content)))
        content = content[:start] + new + content[start + removed :]
    return content


@pytest.mark.parametrize("name", FILES)
def test_the_undamaged_recording_opens(shared_folder: Path, name: str) -> None:
    assert opens_or_is_refused(shared_folder, name, (shared_folder / name).read_bytes())


@pytest.mark.parametrize("name", FILES)
@FUZZ
@given(changes=edits)
def test_edited_bytes_are_refused_in_words(
    shared_folder: Path, name: str, changes: list[Edit]
) -> None:
    reach = 128 if name.endswith(".npy") else 10_000
    opens_or_is_refused(
        shared_folder, name, edited((shared_folder / name).read_bytes(), changes, reach)
    )


@pytest.mark.parametrize("name", FILES)
@FUZZ
@given(share=st.floats(0, 1))
def test_truncated_files_are_refused_in_words(shared_folder: Path, name: str, share: float) -> None:
    content = (shared_folder / name).read_bytes()
    kept = content[: int(share * len(content))]
    opened = opens_or_is_refused(shared_folder, name, kept)
    if name.endswith(".npy") and len(kept) < len(content):
        assert not opened


@pytest.mark.parametrize("name", FILES)
@FUZZ
@given(content=st.binary(max_size=300) | st.text(max_size=300).map(str.encode))
def test_arbitrary_bytes_are_refused_in_words(
    shared_folder: Path, name: str, content: bytes
) -> None:
    assert not opens_or_is_refused(shared_folder, name, content)


KEYS = [
    *("format", "version", "depth_kind", "modulation_frequency_hz", "saturation_amplitude"),
    *("tool_from_camera", "camera", "camera.width", "camera.height", "camera.K"),
    *("camera.distortion", "camera.K.0.0", "camera.K.1", "tool_from_camera.2.1"),
]
scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(10**300, 10**320),
    st.floats(),
    st.text(max_size=8),
    st.binary(max_size=4),
    st.dates(),
)
yaml_values = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=8,
)


@FUZZ
@given(key=st.sampled_from(KEYS), value=yaml_values)
@example(key="camera.width", value=10**400)
@example(key="saturation_amplitude", value="1e999")
@example(key="camera.distortion", value={1: 2})
def test_any_value_of_any_key_is_taken_or_refused_in_words(
    shared_folder: Path, key: str, value: Any
) -> None:
    values = yaml.safe_load((shared_folder / "recording.yaml").read_text())
    put(values, key, value)
    content = yaml.safe_dump(values, allow_unicode=True).encode("utf-8", "surrogatepass")
    opens_or_is_refused(shared_folder, "recording.yaml", content)


@pytest.mark.parametrize(
    "content",
    [
        b"!!bool maybe",
        b"format: !!int ''",
        b"format: !!timestamp x",
        b"? [a]\n: b",
        b"camera: {width: 0x" + b"f" * 5000 + b"}\nformat: a\nversion: 1",
        b"[" * 5000,
        b"a: &a [x,x]\nb: &b [*a,*a]\nformat: tofcorr-recording\nversion: 1\ncamera: *b\n",
        b"format: tofcorr-recording\nversion: 1\ncamera: &c {width: *c}\n",
        b"\x00",
    ],
)
def test_hostile_yaml_is_refused_in_words(shared_folder: Path, content: bytes) -> None:
    assert not opens_or_is_refused(shared_folder, "recording.yaml", content)


CELLS = st.one_of(
    st.text(max_size=6),
    st.floats().map(repr),
    st.integers().map(str),
    st.sampled_from(["", "nan", "-inf", "1e309", "0x1p4", "1_0", "٣", '"', "1,2", "\n", "\x00"]),
)


@FUZZ
@given(row=st.integers(0, 6), column=st.integers(0, 18), cell=CELLS)
def test_any_text_in_any_cell_is_taken_or_refused_in_words(
    shared_folder: Path, row: int, column: int, cell: str
) -> None:
    lines = [line.split(",") for line in (shared_folder / "frames.csv").read_text().splitlines()]
    lines[row][column] = cell
    text = "\n".join(",".join(line) for line in lines)
    opens_or_is_refused(shared_folder, "frames.csv", text.encode("utf-8", "surrogatepass"))


def test_a_cell_longer_than_the_parser_takes_is_refused_in_words(shared_folder: Path) -> None:
    text = (shared_folder / "frames.csv").read_text().replace("white", "w" * 200_000, 1)
    assert not opens_or_is_refused(shared_folder, "frames.csv", text.encode())


def npy_bytes(header: str, version: tuple[int, int], body: bytes) -> bytes:
    text = header.encode("utf-8", "surrogatepass") + b"\n"
    length = len(text).to_bytes(2 if version == (1, 0) else 4, "little")
    return b"\x93NUMPY" + bytes(version) + length + text + body


@FUZZ
@given(
    descr=st.sampled_from(["'<f4'", "'>f4'", "'|O'", "'<f8'", "'V9'", "[('a','<f4')]", "3", "''"])
    | st.text(max_size=6).map(repr),
    order=st.sampled_from(["False", "True", "0", "'C'"]),
    shape=st.lists(st.integers(-3, 2**70) | st.just(10**30), max_size=5).map(
        lambda sides: repr(tuple(sides))
    )
    | st.sampled_from(
        ["(6, 5, 7)", "(6, 5, 7.0)", "6", "(True, 5, 7)", "((6,), 5, 7)", "-", "(0, 5, 7)"]
    ),
    version=st.sampled_from([(1, 0), (2, 0), (3, 0), (9, 9)]),
)
@example(descr="'<f4'", order="False", shape="(6L, 5L, 7L)", version=(1, 0))
@example(descr="'<f4'", order="False", shape="(6, 5, (", version=(1, 0))
def test_any_array_header_is_taken_or_refused_in_words(
    shared_folder: Path, descr: str, order: str, shape: str, version: tuple[int, int]
) -> None:
    header = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}"
    body = (shared_folder / "depth.npy").read_bytes()[128:]
    opens_or_is_refused(shared_folder, "depth.npy", npy_bytes(header, version, body))


def test_an_archive_in_place_of_an_array_is_refused_in_words(shared_folder: Path) -> None:
    archive = io.BytesIO()
    np.savez(archive, depth=np.ones((6, 5, 7), dtype=np.float32))
    assert not opens_or_is_refused(shared_folder, "depth.npy", archive.getvalue())
