"""Every format of deployment, registered once.

A new format is a file in this folder and one line here. The file is called as the format and holds
`export_<format>(corrector, path, reference)`, which writes `path` whole or not at all.
"""

from collections.abc import Collection
from dataclasses import dataclass
from importlib.util import find_spec

from tofcorr.errors import ConfigError, did_you_mean


@dataclass(frozen=True)
class Format:
    """What one format says of itself; known without importing torch.

    Attributes:
        name: In `--format`, and of the file that writes it.
        ending: What its files usually end in.
        summary: For whom it is, in a few words.
        scene: What of the scene's light it removes, as `scene` of a calibration names it; None: it
            corrects no depth.
        packages: Packages that writing or reading it needs besides the required ones.
        extra: The extra of tofcorr that installs them.
        for_device: Whether the file is compiled for one device, `cpu` or `cuda`.
        record: What the name of a record in its archives holds, by which `tofcorr.load_corrector`
            knows them; empty: no archive, or no corrector.
        runs_code: Whether loading the file runs what stands in it.
    """

    name: str
    ending: str
    summary: str
    scene: tuple[str, ...] | None = None
    packages: tuple[str, ...] = ()
    extra: str = ""
    for_device: bool = False
    record: str = ""
    runs_code: bool = False

    def require_packages(self) -> None:
        """Refuse to go on without the packages that the format needs.

        Raises:
            ConfigError: One of them is not installed.
        """
        missing = [name for name in self.packages if find_spec(name) is None]
        if missing:
            extra = f"pip install 'tofcorr[{self.extra}]'"
            raise ConfigError(f"The {self.name} export needs {' and '.join(missing)}: {extra}.")

    def holds(self, scene: Collection[str]) -> bool:
        """Return whether it corrects depth, and removes all this of the scene's light."""
        return self.scene is not None and set(scene) <= set(self.scene)


_ONNX = ("onnx", "onnxscript", "onnxruntime")
_FLYING = ("flying_pixels",)
_NO_BOUNCES = ("stray_light", *_FLYING)
_ALL = (*_NO_BOUNCES, "second_bounces")

_FORMATS = (
    Format("torchscript", ".ts", "any machine with torch", _ALL, record="/code/", runs_code=True),
    Format(
        "pt2",
        ".pt2",
        "the fastest; compiled for this kind of processor",
        _NO_BOUNCES,
        for_device=True,
        record="/aotinductor/",
        runs_code=True,
    ),
    Format("onnx", ".onnx", "without torch", _NO_BOUNCES, packages=_ONNX, extra="onnx"),
    Format("c", ".c", "without any library: C99 for robots, compiled there", _FLYING),
    Format("lut", ".npz", "table for NumPy, to 0.1 mm", (), record="radial_of_z.npy"),
    Format("urdf", ".xacro", "the camera's pose as a fixed joint of a robot description"),
    Format("tf", ".yaml", "the camera's pose for ROS, with the commands that publish it"),
    Format("easy_handeye", ".yaml, or .calib for easy_handeye2", "the camera's pose for ROS"),
    Format("opencv", ".yml", "intrinsics, camera's pose and coefficients for cv::FileStorage"),
)

FORMATS = {one.name: one for one in _FORMATS}
"""Every format by its name."""

ALIASES = {
    **dict.fromkeys(("ts", "pt", "jit"), "torchscript"),
    **dict.fromkeys(("npz", "numpy", "table"), "lut"),
    "aoti": "pt2",
    "c99": "c",
    "xacro": "urdf",
    "calib": "easy_handeye",
    "yml": "opencv",
}
"""Formats by the other names that people try."""


def format_named(name: str) -> Format:
    """Return a format.

    Raises:
        ConfigError: There is no format of this name.
    """
    plain = name.lower().lstrip(".")
    if (own := ALIASES.get(plain, plain)) not in FORMATS:
        hint = did_you_mean(plain, [*FORMATS, *ALIASES])
        raise ConfigError(f"'{name}' is no format of export.{hint} Known: {', '.join(FORMATS)}.")
    return FORMATS[own]
