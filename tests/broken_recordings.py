"""Every damage that is refused, by name, and what the reader must say of it."""

import numpy as np
from recording_damage import (
    Damage,
    array,
    cells,
    column_edit,
    header,
    only_header,
    removed,
    text,
    truncated,
    value,
    without_column,
    without_key,
)

IDENTITY = np.eye(4)
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])
SHEAR = IDENTITY + 0.01 * np.eye(4, k=1) * [[1], [1], [0], [0]]
REFUSALS: dict[str, tuple[Damage, str]] = {
    # A missing file.
    "no header": (removed("recording.yaml"), r"recording\.yaml: there is no such file"),
    "no table": (removed("frames.csv"), r"frames\.csv: there is no such file"),
    "no depth": (removed("depth.npy"), r"depth\.npy: there is no such file"),
    # The header.
    "other format": (header(format="rosbag"), r"recording\.yaml: 'format': .*got 'rosbag'"),
    "no format": (without_key("format"), r"'format' is missing; is this a recording"),
    "no version": (without_key("version"), r"'version' is missing"),
    "other version": (header(version=2), r"'version': .*got 2"),
    "version in words": (header(version="one"), r"'version': .*got 'one'"),
    "version as truth value": (header(version=True), r"'version': .*got True"),
    "no camera size": (without_key("width"), r"'camera\.width' is missing"),
    "no distortion": (without_key("distortion"), r"'camera\.distortion' is missing"),
    "no depth kind": (without_key("depth_kind"), r"'depth_kind' is missing"),
    "misspelt key": (
        lambda folder: (
            without_key("saturation_amplitude")(folder),
            header(saturation_amplitde=3)(folder),
        )[0],
        r"'saturation_amplitde' is not a known key\. Did you mean 'saturation_amplitude'",
    ),
    "other depth kind": (header(depth_kind="depth"), r"'depth_kind': .*'radial' or 'z'"),
    "K with a lower entry": (
        header(camera={"K": [[9.0, 0, 3], [0.1, 9.0, 2], [0, 0, 1.0]]}),
        r"'camera\.K': K must be upper triangular",
    ),
    "K with a scaled last row": (
        header(camera={"K": [[9.0, 0, 3], [0, 9.0, 2], [0, 0, 2.0]]}),
        r"last row of 0 0 1",
    ),
    "negative focal length": (
        header(camera={"K": [[9.0, 0, 3], [0, -9.0, 2], [0, 0, 1.0]]}),
        r"'camera\.K': the focal lengths of K must be positive",
    ),
    "NaN in K": (
        header(camera={"K": [[float("nan"), 0, 3], [0, 9.0, 2], [0, 0, 1.0]]}),
        r"'camera\.K\.0\.0': .*finite",
    ),
    "K of two rows": (
        header(camera={"K": [[9.0, 0, 3], [0, 9.0, 2]]}),
        r"'camera\.K\.2'.* missing",
    ),
    "three distortion coefficients": (
        header(camera={"distortion": [0.1, 0.2, 0.3]}),
        r"'camera\.distortion': .* got 3",
    ),
    "width of zero": (header(camera={"width": 0}), r"'camera\.width': .*greater than 0"),
    "more pixels than any camera": (
        header(camera={"width": 100_000, "height": 100_000}),
        r"'camera': an image of 100000 x 100000 pixels is larger",
    ),
    "huge focal length": (
        header(camera={"K": [[1e11, 0, 3], [0, 9.0, 2], [0, 0, 1.0]]}),
        r"'camera\.K': the focal lengths of K must be 0\.001 to 1e\+09 pixels",
    ),
    "huge distortion": (
        header(camera={"distortion": [1e300, 0, 0, 0]}),
        r"'camera\.distortion\.0': .*less than or equal to",
    ),
    "width of half a pixel": (header(camera={"width": 7.5}), r"'camera\.width'"),
    "true as a height": (header(camera={"height": True}), r"'camera\.height': .*not true or false"),
    "huge width": (header(camera={"width": 10**400}), r"'camera\.width'"),
    "frequency of zero": (header(modulation_frequency_hz=0), r"'modulation_frequency_hz'"),
    "negative saturation": (header(saturation_amplitude=-1.0), r"'saturation_amplitude'"),
    "mirrored hand-eye": (
        header(tool_from_camera=MIRROR.tolist()),
        r"'tool_from_camera': .*reflection",
    ),
    "sheared hand-eye": (
        header(tool_from_camera=SHEAR.tolist()),
        r"'tool_from_camera': .*orthonormal",
    ),
    "hand-eye with a last row": (
        header(tool_from_camera=(IDENTITY * [1, 1, 1, 2]).tolist()),
        r"last row .* 0 0 0 1",
    ),
    "hand-eye in millimetres of infinity": (
        header(tool_from_camera=np.where(IDENTITY == 1, np.inf, 0).tolist()),
        r"finite",
    ),
    "planes of another origin": (
        header(planes="guessed"),
        r"recording\.yaml: 'planes': .*'recorded' or 'estimated' \(got 'guessed'\)",
    ),
    "a frame of another kind": (
        header(frames={"wrist": "tool0"}),
        r"recording\.yaml: 'frames\.wrist' is not a known key",
    ),
    "a nameless frame": (header(frames={"tool": ""}), r"recording\.yaml: 'frames\.tool'"),
    "frames in a row": (header(frames=["base", "tool0"]), r"recording\.yaml: 'frames'"),
    "a list for a header": (text("recording.yaml", "- 1\n- 2\n"), r"expected keys and values"),
    "no YAML": (text("recording.yaml", "camera: [1, 2"), r"recording\.yaml: not valid YAML"),
    "binary header": (text("recording.yaml", b"\xff\xfe\x00\x81"), r"cannot be read as text"),
    "wrong tag": (text("recording.yaml", "format: !!bool maybe"), r"not valid YAML"),
    "huge header": (text("recording.yaml", "#" * 16_000_001), r"larger than 16 MB"),
    # The table.
    "no frame": (only_header, r"frames\.csv: a recording of no frame"),
    "empty table": (text("frames.csv", ""), r"frames\.csv: is empty"),
    "semicolons": (text("frames.csv", "frame;tx\n0;1\n"), r"separated by ';'"),
    "missing columns": (column_edit(without_column("qw")), r"frames\.csv: column 'qw' is missing"),
    "no target column": (column_edit(without_column("target")), r"column 'target' is missing"),
    "a column twice": (
        lambda folder: text(
            "frames.csv", (folder / "frames.csv").read_text().replace("ambient", "tx", 1)
        )(folder),
        r"column 'tx' appears twice",
    ),
    "a short row": (
        lambda folder: text(
            "frames.csv", (folder / "frames.csv").read_text().rstrip().rsplit(",", 1)[0]
        )(folder),
        r"frame 5 has 18 cells; the header has 19",
    ),
    "an index left out": (
        column_edit(lambda rows: rows[:2] + rows[3:]),
        r"frame 2, column 'frame': expected 2 \(counting up from zero\), got '3'",
    ),
    "indices from one": (
        column_edit(lambda rows: [row | {"frame": str(i + 1)} for i, row in enumerate(rows)]),
        r"frame 0, column 'frame': expected 0",
    ),
    "fewer rows than frames": (
        column_edit(lambda rows: rows[:4]),
        r"depth\.npy: has 6 frames; frames\.csv has 4 rows",
    ),
    "text for a number": (cells(3, ty="left"), r"frame 3, column 'ty': .*number, got 'left'"),
    "an underscore in a number": (cells(3, ty="1_0"), r"frame 3, column 'ty': .*got '1_0'"),
    "an empty pose": (cells(1, tz=""), r"frame 1, column 'tz': .*got an empty cell"),
    "NaN in a pose": (cells(4, qx="nan"), r"frame 4, column 'qx': expected a finite number"),
    "infinite plane": (cells(2, d="inf"), r"frame 2, column 'd': expected a finite number"),
    "overflowing plane": (cells(2, d="1e999"), r"frame 2, column 'd': expected a finite number"),
    "long quaternion": (
        cells(5, qx="0", qy="0", qz="0", qw="1.002"),
        r"frame 5: the quaternion .* length 1\.002",
    ),
    "zero quaternion": (cells(5, qx="0", qy="0", qz="0", qw="0"), r"quaternion .* length 0"),
    "enormous quaternion": (cells(5, qx="1e9"), r"frame 5: the quaternion .* length 1e\+09"),
    "short normal": (
        cells(0, nx="0", ny="0", nz="0.99"),
        r"frame 0: the normal nx,ny,nz has length 0\.99",
    ),
    "nameless target": (cells(1, target=" "), r"frame 1, column 'target': .*name"),
    "no time": (cells(1, timestamp_s=""), r"frame 1, column 'timestamp_s'"),
    "negative integration time": (
        cells(1, integration_time_us="-5"),
        r"frame 1, column 'integration_time_us': .*positive",
    ),
    "infinite temperature": (cells(1, body_temperature_c="inf"), r"'body_temperature_c': .*finite"),
    "text for ambient": (cells(1, ambient="dark"), r"frame 1, column 'ambient': .*'dark'"),
    "a position beyond any robot": (
        cells(2, tx="-2e6"),
        r"frame 2, column 'tx': .*metres, at most",
    ),
    "a number beyond any unit": (cells(2, qx="1e200"), r"frame 2, column 'qx': .*at most 1e\+12"),
    "a temperature beyond any sun": (
        cells(2, body_temperature_c="1e300"),
        r"frame 2, column 'body_temperature_c': .*finite",
    ),
    "binary table": (text("frames.csv", b"\xff\xfe\x00\x81"), r"cannot be read as CSV"),
    # The arrays.
    "float64 depth": (
        array("depth", lambda a: a.astype(np.float64)),
        r"depth\.npy: expected float32.*float64",
    ),
    "big-endian depth": (array("depth", lambda a: a.astype(">f4")), r"depth\.npy: .*got .*>f4"),
    "integer amplitude": (
        array("amplitude", lambda a: a.astype(np.int32)),
        r"amplitude\.npy: expected float32",
    ),
    "boolean mask": (array("mask", lambda a: a.astype(bool)), r"mask\.npy: expected uint8"),
    "depth of another camera": (
        array("depth", lambda a: a[:, :, :-1]),
        r"depth\.npy: expected shape \(frames, 5, 7\), got \(6, 5, 6\)",
    ),
    "transposed depth": (array("depth", lambda a: a.transpose(0, 2, 1).copy()), r"\(6, 7, 5\)"),
    "flat depth": (array("depth", lambda a: a.reshape(6, -1)), r"got \(6, 35\)"),
    "Fortran order": (array("depth", np.asfortranarray), r"depth\.npy: is in Fortran order"),
    "three samples": (
        array("raw", lambda a: a[:, :3]),
        r"raw\.npy: expected shape \(frames, 4, 5, 7\)",
    ),
    "fewer amplitudes": (array("amplitude", lambda a: a[:5]), r"amplitude\.npy: has 5 frames"),
    "more masks": (
        array("mask", lambda a: np.concatenate([a, a])),
        r"mask\.npy: has 12 frames.* 6 rows",
    ),
    "truncated depth": (truncated("depth.npy"), r"depth\.npy: not a readable \.npy file"),
    "empty mask file": (text("mask.npy", ""), r"mask\.npy: not a readable \.npy file"),
    "pickled depth": (
        array("depth", lambda a: a.astype(object)),
        r"depth\.npy: not a readable \.npy file",
    ),
    "a largest number for no return": (
        value("depth", (3, 1, 2), 3.4e38),
        r"depth\.npy: frame 3, row 1, column 2: 3\.4e\+38 is no distance in metres",
    ),
    "negative amplitude": (
        value("amplitude", (4, 2, 3), -0.5),
        r"amplitude\.npy: frame 4, row 2, column 3: negative amplitude -0\.5",
    ),
    "amplitude of a largest number": (
        value("amplitude", (4, 2, 3), 3e38),
        r"amplitude\.npy: frame 4, row 2, column 3: no amplitude: 3e\+38",
    ),
    "a sample of a largest number": (
        value("raw", (4, 1, 2, 3), -3e38),
        r"raw\.npy: frame 4, A1, row 2, column 3: -3e\+38 is larger",
    ),
    "mask of 255": (
        value("mask", (1, 0, 6), 255),
        r"mask\.npy: frame 1, row 0, column 6: expected 0 or 1",
    ),
}
