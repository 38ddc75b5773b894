"""The calibration as robots load it; correctors are compared with the float64 model first."""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from tofcorr.correction.export.registry import FORMATS, format_named
from tofcorr.errors import ConfigError

if TYPE_CHECKING:
    from tofcorr.correction.corrector import DepthCorrector
    from tofcorr.correction.state import CalibrationState


def export(
    name: str, corrector: "DepthCorrector", path: Path | str, reference: "CalibrationState"
) -> None:
    """Write the corrector in a registered format, once it agrees with the float64 model.

    Raises:
        ConfigError: There is no such format, it needs something that is not installed, or it
            cannot hold the model, or what of the scene's light is removed.
        ExportError: The export differs from the model, or cannot be written; there is no new file.
    """
    chosen = format_named(name)
    chosen.require_packages()
    scene = [part for part, wanted in reference.scene if wanted is not None]
    if chosen.scene is not None and not chosen.holds(scene):
        lacking = " and ".join(part for part in scene if part not in chosen.scene)
        others = ", ".join(one.name for one in FORMATS.values() if one.holds(scene))
        raise ConfigError(f"The {chosen.name} export holds no {lacking}: export {others}.")
    module = import_module(f"tofcorr.correction.export.{chosen.name}")
    getattr(module, f"export_{chosen.name}")(corrector, path, reference)
